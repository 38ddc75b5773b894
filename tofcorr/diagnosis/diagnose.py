"""The whole diagnosis of one recording, step by step."""

from collections.abc import Callable, Mapping
from contextlib import nullcontext
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from tofcorr.data.recording import Recording
from tofcorr.diagnosis.findings.gap import (
    gap_steps,
    judge_remainder,
    measure_gap,
    resampled,
    stages_of,
)
from tofcorr.diagnosis.findings.naming import name_effects
from tofcorr.diagnosis.findings.outliers import (
    Outliers,
    headline_of_given,
    mask_warning,
    outliers_of,
    refuse_impossible_gap,
)
from tofcorr.diagnosis.findings.shares import attribute, explained_squares, parts_of
from tofcorr.diagnosis.given import (
    OpenSimulator,
    Simulator,
    open_simulator,
    simulated_error,
)
from tofcorr.diagnosis.next.advice import minimum_detectable, next_recording
from tofcorr.diagnosis.options import DiagnosisOptions
from tofcorr.diagnosis.report.result import DiagnosisResult, write_report
from tofcorr.diagnosis.report.words import list_causes, list_remarks, write_verdict
from tofcorr.diagnosis.rerun.checks import (
    check_in_simulator,
    degraded_stage,
    measure_transfer,
    noisy_frames,
)
from tofcorr.diagnosis.rerun.simulator import Evidence, fitted_values, whole_patterns
from tofcorr.diagnosis.sums.base import (
    BaseModel,
    SimulatorError,
    definite_base,
    filtered_inputs,
    fit_base,
)
from tofcorr.diagnosis.sums.linearised import in_best_forms
from tofcorr.diagnosis.sums.observations import (
    TINY,
    Observations,
    effect_inputs,
    observe,
    with_numbered_walls,
)
from tofcorr.diagnosis.sums.study import (
    FittedMap,
    Study,
    build_study,
    without_absorbed,
    without_map,
)
from tofcorr.error_terms.pixel_terms import FixedPatternOptions
from tofcorr.errors import CalibrationDataError
from tofcorr.estimation.linear import solvable
from tofcorr.files import staged_folder
from tofcorr.observables.compare import Observables
from tofcorr.options import resolve_options
from tofcorr.pixels.dataset import Dataset, opened, resolved_planes, thread_number
from tofcorr.plausibility.examine import vet
from tofcorr.progress import stages
from tofcorr.simulation.effects import CATALOGUE, MapEffect
from tofcorr.simulation.options import SimulatorOptions


def diagnose(
    recording: Recording | Path | str,
    sim: Simulator | None = None,
    config: DiagnosisOptions | Mapping[str, Any] | Path | str | None = None,
    *,
    out: Path | str | None = None,
    force: bool = False,
) -> DiagnosisResult:
    """Find where a simulator and a recording differ, and which effect the simulator lacks.

    Args:
        recording: The real recording, or its folder.
        sim: The simulator under diagnosis. The built-in one: the name of a shipped configuration
            (`"demo"`), a YAML file, keys and values, or options. Any other one: a recording that
            it rendered, or its folder, or a function that takes the recording and returns depth
            (N, H, W) at its poses, or a mapping with `depth`, and optionally `amplitude` and
            `tool_from_camera`. None: a simulator is fitted to the recording.
        config: Options of the diagnosis: the name of a shipped configuration (`"many"`), a YAML
            file, keys and values, or options. None: the defaults.
        out: Folder for the report, made anew; None: nothing is written.
        force: Diagnose whatever the recording looks like.

    Returns:
        All findings; printed, it is the verdict.

    Raises:
        ConfigError: An option or an effect is unknown.
        CalibrationDataError: The recording cannot support a diagnosis, or cannot be what it says
            (see `tofcorr.inspect`), or is too far from any camera to name a cause
            (`findings.outliers`); the simulator's frames cannot be compared with it, or `out`
            exists or cannot be written.
    """
    # First of all: what cannot be written is refused before any work.
    with staged_folder(out) if out is not None else nullcontext() as folder:
        (recording,) = opened(recording)
        options = resolve_options(DiagnosisOptions, {} if config is None else config)
        with (
            thread_number(options.threads),
            stages("diagnosing", 5 if folder is None else 6) as begin,
            solvable(recording.path, "diagnosis"),
        ):
            begin("fitting the base model")
            planes = resolved_planes("auto", [recording])
            inspection = vet(Dataset((recording,)), planes, force=force)
            simulator = open_simulator(sim, recording)
            prepared = prepare(recording, options, simulator)
            if not force:
                refuse_impossible_gap(prepared.study, inspection)
            result = conclude(prepared, simulator, begin)
            first = [inspection.headline, headline_of_given(result.gap.as_given), result.verdict]
            result = replace(result, verdict=" ".join(filter(None, first)))
            if folder is not None:
                begin("writing the report")
                write_report(result, folder)
        return result


@dataclass(frozen=True, kw_only=True)
class Prepared:
    """A recording ready for diagnosis.

    Attributes:
        study: Pixels, base fit, candidate effects and sums.
        warnings: What was unexpected, a sentence each.
        as_given: Residual of the simulator as given, shape (M,), metres; None without one.
        outliers: Pixels that the fit does not fully use.
    """

    study: Study
    warnings: tuple[str, ...]
    as_given: Tensor | None
    outliers: Outliers


def prepare(
    recording: Recording, options: DiagnosisOptions, simulator: OpenSimulator | None = None
) -> Prepared:
    """Read the recording, fit the base model and compute all sums.

    Args:
        recording: The real recording.
        options: Of the diagnosis.
        simulator: The simulator under diagnosis; None: one is fitted to the recording.

    Raises:
        CalibrationDataError: The recording lacks what a base term needs, has too few frames, or its
            planes are estimated and cannot be estimated anew; or the simulator's frames cannot be
            compared with it.
    """
    camera = recording.camera
    if min(camera.width, camera.height) < 2:
        raise CalibrationDataError(
            f"{recording.path}: a diagnosis compares neighbouring pixels, and images of "
            f"{camera.width}x{camera.height} pixels have none; 2x2 at least are needed."
        )
    base, warnings = definite_base(recording, options.base)
    observations = with_numbered_walls(observe(recording, options.most_pixels))
    known = None
    if simulator is not None:
        observations, known, limits = _both_known(observations, simulator, options)
        warnings = [*warnings, *limits]
    free = recording.moves if options.hand_eye == "auto" else options.hand_eye == "estimate"
    model = BaseModel(observations, base, hand_eye_free=free)
    fit = fit_base(model, observations, known)
    observations = fit.model.observations
    as_given = None if known is None else known.residual(observations)
    inputs = effect_inputs(observations, fit.tool_from_camera)
    inputs = filtered_inputs(inputs, observations, fit)
    study = in_best_forms(build_study(options, observations, fit, inputs))
    study, absorbed = without_absorbed(study)
    study = _with_base_pattern(study)
    outliers = outliers_of(study)
    warnings += filter(None, (outliers.warning, mask_warning(observations), *absorbed))
    return Prepared(study=study, warnings=tuple(warnings), as_given=as_given, outliers=outliers)


def _both_known(
    observations: Observations, simulator: OpenSimulator, options: DiagnosisOptions
) -> tuple[Observations, SimulatorError, list[str]]:
    """Return the pixels for which a simulator has a distance, its error there, and warnings.

    With fewer than a tenth of the pixels the comparison would be about another recording; a
    thousandth without a distance is worth a warning.
    """
    error = simulated_error(simulator, observations, options)
    limits = list(error.limits)
    known = error.error.isfinite()
    share = float(known.double().mean())
    frames = len(torch.unique(observations.frame[known]))
    if 10 * share < 1 or frames < 2:
        raise CalibrationDataError(
            f"{observations.recording.path}: the simulator has a distance for {100 * share:.1f} % "
            f"of the recording's pixels, in {frames} frames; simulate its poses and targets, or "
            "a range of distances and amplitudes that covers it."
        )
    if 1000 * (1 - share) >= 1:
        limits.append(
            f"The simulator has no distance for {100 * (1 - share):.1f} % of the recording's "
            "pixels; they are left out."
        )
    return observations.at(known), error.at(known), limits


def _with_base_pattern(study: Study) -> Study:
    """Subtract the fixed pattern of the base model, if it has one.

    Each pixel's value is estimated from the poses of other folds, as with a map that is named. The
    spread `auto` is what the residual has in common in all images.
    """
    terms = study.fit.model.options.terms
    term = next((term for term in terms if isinstance(term, FixedPatternOptions)), None)
    if term is None:
        return study
    kind = CATALOGUE[term.kind]
    pattern = kind.for_recording(study.inputs)
    assert isinstance(pattern, MapEffect)
    spread = None if term.spread_mm == "auto" else term.spread_mm / 1000
    fitted = FittedMap(study, pattern, study.residual_of(()), prior_sd=spread, least_sd=TINY)
    study = without_map(study, fitted.values, {kind.name, *kind.contains})
    return replace(study, pattern=pattern.with_coefficients(fitted.whole()))


def conclude(
    prepared: Prepared, simulator: OpenSimulator | None, begin: Callable[[str], object]
) -> DiagnosisResult:
    """Return all findings; their verdict is that of the gap, without doubts about the recording.

    Args:
        prepared: The recording, before any effect was named.
        simulator: The simulator under diagnosis; None: one is fitted to the recording.
        begin: Called with the name of each stage.
    """
    study, residual = prepared.study, prepared.as_given
    options, recording = study.options, study.observations.recording
    begin("naming effects")
    generator = torch.Generator().manual_seed(options.seed + 1)
    resamples = resampled(study.observations.num_units, options.bootstraps, generator)
    named = name_effects(study)
    given = simulator if isinstance(simulator, SimulatorOptions) else None
    frames = simulator if isinstance(simulator, Recording) else None
    found = Evidence(study=study, named=named, given=given)

    begin("measuring the gap")
    parts, explained = parts_of(study, named, residual), None
    if residual is not None:
        explained = explained_squares(parts, resamples)
    gap = measure_gap(study, named, resamples, explained)
    shares = attribute(parts, gap, resamples)
    begin("judging what remains")
    stages = stages_of(study, named, gap, residual)
    remainder = judge_remainder(study, named, gap)
    detectable = minimum_detectable(study, named, options.seed + 2)

    closure = transfer = degraded = None
    if options.simulate_anew:
        transfer = measure_transfer(found, generator, resamples)
        degraded = degraded_stage(found, gap.floor, resamples)
        closure = check_in_simulator(found)
    if given is not None:
        frames = noisy_frames(recording, given, options.seed + 3)
    observables = Observables(recording, frames, seed=options.seed + 3, level=options.tests.level)
    found = replace(found, patterns=whole_patterns(found))
    beyond = [] if found.rendered else found.tables[1]
    warnings = list(prepared.warnings)
    if beyond:
        warnings.append(
            "simulator_with_effects.yaml lacks these terms of the base model: "
            f"{', '.join(term.options.kind for term, _ in beyond)}. The simulator has no table for "
            "them; the findings include them."
        )
    return DiagnosisResult(
        verdict=write_verdict(named, gap, remainder, shares),
        causes=list_causes(found, shares),
        remarks=list_remarks(found, gap, remainder, detectable),
        simulator_kind="fitted" if simulator is None else "given" if given else "rendered",
        stages=stages,
        shares=shares,
        warnings=tuple(warnings),
        detected=named.tested and (bool(named.names) or remainder.unknown),
        probability=named.anything,
        effects=named.names,
        cause_sets=named.cause_sets,
        gap=gap,
        gap_steps=tuple(gap_steps(study, named, gap, resamples)),
        remainder=remainder,
        outliers=prepared.outliers,
        detectable=detectable,
        advice=tuple(next_recording(study, named)),
        closure=closure,
        transfer=transfer,
        fitted=fitted_values(found, resamples),
        degraded=degraded,
        observables=observables,
        simulator=None if found.rendered else found.simulator,
        options=options,
        evidence=found,
    )
