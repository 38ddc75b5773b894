"""The whole diagnosis of one recording, step by step."""

from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch

from tofcorr.data.recording import Recording
from tofcorr.diagnosis.findings.attribution import attribute, explained_squares
from tofcorr.diagnosis.findings.effect_comparison import least_p_value
from tofcorr.diagnosis.findings.how_far import gap_steps, measure_gap
from tofcorr.diagnosis.findings.impossible import headline_of_given, refuse_impossible_gap
from tofcorr.diagnosis.findings.naming import NamedEffects, name_effects
from tofcorr.diagnosis.findings.open_set import judge_remainder
from tofcorr.diagnosis.findings.parts import parts_of
from tofcorr.diagnosis.findings.ranking import rank_effects
from tofcorr.diagnosis.findings.resamples import draw_resamples
from tofcorr.diagnosis.findings.stages import stages_of
from tofcorr.diagnosis.given.simulator import GivenSimulator
from tofcorr.diagnosis.given.source import Simulator, open_simulator
from tofcorr.diagnosis.next.advice import next_recording
from tofcorr.diagnosis.next.detectable import minimum_detectable
from tofcorr.diagnosis.options import DiagnosisOptions
from tofcorr.diagnosis.prepare import prepare
from tofcorr.diagnosis.report.evidence import Evidence
from tofcorr.diagnosis.report.remarks import list_causes, list_remarks
from tofcorr.diagnosis.report.result import DiagnosisResult
from tofcorr.diagnosis.report.verdict import write_verdict
from tofcorr.diagnosis.report.write import write_report
from tofcorr.diagnosis.rerun.closure import check_in_simulator
from tofcorr.diagnosis.rerun.degraded_stage import degraded_stage
from tofcorr.diagnosis.rerun.fitted_simulator import simulator_of, tables_of
from tofcorr.diagnosis.rerun.fitted_values import fitted_values
from tofcorr.diagnosis.rerun.noisy_frames import observables_of
from tofcorr.diagnosis.rerun.transfer import measure_transfer
from tofcorr.diagnosis.sums.study import Study
from tofcorr.errors import CalibrationDataError
from tofcorr.options import resolve_options
from tofcorr.pixels.dataset import Dataset
from tofcorr.pixels.plane_choice import resolved_planes
from tofcorr.pixels.thread_number import thread_number
from tofcorr.plausibility.examine import vet
from tofcorr.plausibility.inspection import Inspection
from tofcorr.progress import stages
from tofcorr.simulation.options import SimulatorOptions

# Stages that the progress bar counts; writing the report is one more.
_STAGES = 5


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
            (`findings.impossible`); the simulator's frames cannot be compared with it, or `out`
            exists.
    """
    if not isinstance(recording, Recording):
        recording = Recording.open(Path(recording))
    simulator = open_simulator(sim)
    options = DiagnosisOptions() if config is None else resolve_options(DiagnosisOptions, config)
    planes = resolved_planes("auto", [recording])
    inspection = vet(Dataset((recording,)), planes, force=force)
    sound = None if force else inspection
    total = _STAGES if out is None else _STAGES + 1
    with thread_number(options.threads), stages("diagnosing", total) as begin:
        try:
            result = _diagnosed(recording, simulator, options, begin, sound)
        except torch.linalg.LinAlgError:  # pyright: ignore[reportPrivateImportUsage] - documented
            raise CalibrationDataError(
                f"{recording.path}: the equations of the diagnosis have no solution: the frames do "
                "not differ enough, or poses, planes or depth are far off; see `tofcorr inspect`."
            ) from None
        first = [inspection.headline, headline_of_given(result.gap.as_given), result.verdict]
        result = replace(result, verdict=" ".join(sentence for sentence in first if sentence))
        if out is not None:
            begin("writing the report")
            write_report(result, out)
    return result


def _diagnosed(
    recording: Recording,
    simulator: GivenSimulator | None,
    options: DiagnosisOptions,
    begin: Callable[[str], object],
    sound: Inspection | None,
) -> DiagnosisResult:
    begin("fitting the base model")
    prepared = prepare(recording, options, simulator)
    study, residual = prepared.study, prepared.as_given
    if sound is not None:
        refuse_impossible_gap(study, sound)
    given = None if simulator is None else simulator.options
    begin("naming effects")
    named = name_effects(study)
    begin("measuring the gap")
    generator = torch.Generator().manual_seed(options.seed + 1)
    resamples = draw_resamples(study, generator)
    parts = parts_of(study, named, residual)
    explained = None
    if residual is not None:
        once = torch.ones_like(resamples[:1])
        explained = explained_squares(parts, once)[0], explained_squares(parts, resamples)
    gap = measure_gap(study, named, resamples, explained)
    shares = attribute(parts, gap, resamples)
    closure = transfer = degraded = None
    rendered = simulator is not None and given is None
    with_effects = None if rendered else simulator_of(study, named, given)
    begin("simulating anew")
    if options.simulate_anew:
        closure = check_in_simulator(study, named, given)
        transfer = measure_transfer(study, named, given, generator, resamples)
        degraded = degraded_stage(study, named, with_effects, gap.floor, resamples)
    begin("judging what remains")
    stages = stages_of(study, named, gap, residual)
    remainder = judge_remainder(study, named, gap, stages[-1].found_where)
    detectable = minimum_detectable(study, named, options.seed + 2)
    missing = dict(study.candidates.missing)
    beside = None if simulator is None else given or simulator.rendered_frames(recording)
    return DiagnosisResult(
        verdict=write_verdict(named, gap, remainder, shares),
        causes=list_causes(study, named, shares),
        remarks=list_remarks(named, gap, remainder, detectable, list(missing)),
        simulator_kind="fitted" if simulator is None else simulator.kind,
        stages=stages,
        shares=shares,
        warnings=(
            *prepared.warnings,
            *(() if rendered else _simulator_warnings(study, named, given)),
        ),
        detected=named.tested and (bool(named.names) or remainder.unknown),
        p_value=least_p_value(study, named.first),
        effects=named.names,
        cause_sets=named.cause_sets,
        likeliest=named.likeliest,
        refined_terms=named.refined_terms,
        tested=named.tested,
        gap=gap,
        gap_steps=tuple(gap_steps(study, named, gap, resamples)),
        where=stages[1].found_where,
        remainder=remainder,
        outliers=prepared.outliers,
        ranking=rank_effects(study, named),
        missing=missing,
        detectable=detectable,
        advice=tuple(next_recording(study, named)),
        closure=closure,
        transfer=transfer,
        fitted=fitted_values(study, named, () if given is None else given.effects, resamples),
        degraded=degraded,
        observables=observables_of(
            recording, beside, seed=options.seed + 3, level=options.tests.level
        ),
        simulator=with_effects,
        options=options,
        evidence=Evidence(study=study, named=named),
    )


def _simulator_warnings(
    study: Study, named: NamedEffects, given: SimulatorOptions | None
) -> list[str]:
    """Name the base terms that simulator_with_effects.yaml cannot hold."""
    beyond = tables_of(study, named, given).beyond
    if not beyond:
        return []
    return [
        f"simulator_with_effects.yaml lacks these terms of the base model: {', '.join(beyond)}. "
        "The simulator has no table for them; the findings include them."
    ]
