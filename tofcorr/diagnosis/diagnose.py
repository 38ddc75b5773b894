"""The whole diagnosis of one recording, step by step."""

from collections.abc import Callable, Mapping
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch

from tofcorr.data.recording import Recording
from tofcorr.diagnosis.findings.gap import (
    gap_steps,
    judge_remainder,
    measure_gap,
    resampled,
    stages_of,
)
from tofcorr.diagnosis.findings.naming import name_effects
from tofcorr.diagnosis.findings.outliers import headline_of_given, refuse_impossible_gap
from tofcorr.diagnosis.findings.shares import attribute, explained_squares, parts_of
from tofcorr.diagnosis.given import GivenSimulator, Simulator, open_simulator
from tofcorr.diagnosis.next.advice import minimum_detectable, next_recording
from tofcorr.diagnosis.options import DiagnosisOptions
from tofcorr.diagnosis.prepare import Prepared, prepare
from tofcorr.diagnosis.report.result import DiagnosisResult, write_report
from tofcorr.diagnosis.report.words import list_causes, list_remarks, write_verdict
from tofcorr.diagnosis.rerun.checks import (
    check_in_simulator,
    degraded_stage,
    measure_transfer,
    noisy_frames,
)
from tofcorr.diagnosis.rerun.simulator import Evidence, fitted_values, whole_patterns
from tofcorr.estimation.linear import solvable
from tofcorr.files import staged_folder
from tofcorr.observables.compare import compare_observables
from tofcorr.options import resolve_options
from tofcorr.pixels.dataset import Dataset, resolved_planes, thread_number
from tofcorr.plausibility.examine import vet
from tofcorr.progress import stages


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
        if not isinstance(recording, Recording):
            recording = Recording.open(Path(recording))
        options = (
            DiagnosisOptions() if config is None else resolve_options(DiagnosisOptions, config)
        )
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


def conclude(
    prepared: Prepared, simulator: GivenSimulator | None, begin: Callable[[str], object]
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
    resamples = resampled(study.sums.num_units, options.bootstraps, generator)
    named = name_effects(study)
    given = None if simulator is None else simulator.options
    found = Evidence(study=study, named=named, given=given)

    begin("measuring the gap")
    parts, explained = parts_of(study, named, residual), None
    if residual is not None:
        once = torch.ones_like(resamples[:1])
        explained = explained_squares(parts, torch.cat([once, resamples]))
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
    frames = None if simulator is None else simulator.frames
    if given is not None:
        frames = noisy_frames(recording, given, options.seed + 3)
    observables = compare_observables(
        recording, frames, seed=options.seed + 3, level=options.tests.level
    )
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
        simulator_kind="fitted" if simulator is None else simulator.kind,
        stages=stages,
        shares=shares,
        warnings=tuple(warnings),
        detected=named.tested and (bool(named.names) or remainder.unknown),
        probability=named.anything,
        effects=named.names,
        cause_sets=named.cause_sets,
        tested=named.tested,
        gap=gap,
        gap_steps=tuple(gap_steps(study, named, gap, resamples)),
        remainder=remainder,
        outliers=prepared.outliers,
        missing=dict(study.candidates.missing),
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
