"""The whole diagnosis of one recording, step by step."""

from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch

from tofcorr.data.recording import Recording
from tofcorr.diagnosis.findings.effect_comparison import least_p_value
from tofcorr.diagnosis.findings.impossible import headline_of_given, refuse_impossible_gap
from tofcorr.diagnosis.findings.naming import NamedEffects, name_effects
from tofcorr.diagnosis.findings.ranking import rank_effects
from tofcorr.diagnosis.findings.resamples import draw_resamples
from tofcorr.diagnosis.given.simulator import GivenSimulator
from tofcorr.diagnosis.given.source import Simulator, open_simulator
from tofcorr.diagnosis.judge import judge
from tofcorr.diagnosis.options import DiagnosisOptions
from tofcorr.diagnosis.prepare import Prepared, prepare
from tofcorr.diagnosis.report.evidence import Evidence
from tofcorr.diagnosis.report.remarks import list_causes, list_remarks
from tofcorr.diagnosis.report.result import DiagnosisResult
from tofcorr.diagnosis.report.verdict import write_verdict
from tofcorr.diagnosis.report.write import drawn_figures, write_report
from tofcorr.diagnosis.rerun.anew import Anew, simulate_anew
from tofcorr.diagnosis.rerun.fitted_simulator import simulator_of, tables_of
from tofcorr.diagnosis.sums.study import Study
from tofcorr.errors import CalibrationDataError
from tofcorr.options import resolve_options
from tofcorr.pixels.dataset import Dataset
from tofcorr.pixels.plane_choice import resolved_planes
from tofcorr.pixels.thread_number import thread_number
from tofcorr.pixels.two_at_once import two_at_once, two_processes
from tofcorr.plausibility.examine import vet
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
    may_copy: bool = False,
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
        may_copy: Whether a copy of this process (`os.fork`) may do a part of the work beside it, on
            Linux, where `torch.get_num_threads()` is two or more. The findings are the same. Only
            for a program that runs no other threads, such as `tofcorr diagnose`.

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
    total = _STAGES if out is None else _STAGES + 1
    figures: dict[str, str] = {}
    with thread_number(options.threads), stages("diagnosing", total) as begin:
        try:
            begin("fitting the base model")
            prepared = prepare(recording, options, simulator)
            if not force:
                refuse_impossible_gap(prepared.study, inspection)
            with two_processes(may_copy):
                result = _diagnosed(prepared, simulator, begin)
                if out is not None:
                    begin("writing the report")
                    figures = drawn_figures(result)
        except torch.linalg.LinAlgError:  # pyright: ignore[reportPrivateImportUsage] - documented
            raise CalibrationDataError(
                f"{recording.path}: the equations of the diagnosis have no solution: the frames do "
                "not differ enough, or poses, planes or depth are far off; see `tofcorr inspect`."
            ) from None
        first = [inspection.headline, headline_of_given(result.gap.as_given), result.verdict]
        result = replace(result, verdict=" ".join(sentence for sentence in first if sentence))
        if out is not None:
            write_report(result, out, figures)
    return result


def _diagnosed(
    prepared: Prepared, simulator: GivenSimulator | None, begin: Callable[[str], object]
) -> DiagnosisResult:
    study, options = prepared.study, prepared.study.options
    given = None if simulator is None else simulator.options
    begin("naming effects")
    named = name_effects(study)
    generator = torch.Generator().manual_seed(options.seed + 1)
    resamples = draw_resamples(study, generator)
    rendered = simulator is not None and given is None
    with_effects = None if rendered else simulator_of(study, named, given)

    def simulated() -> Anew:
        begin("simulating anew")
        if not options.simulate_anew:
            return Anew()
        return simulate_anew(study, named, given, with_effects, generator, resamples)

    judged, anew = two_at_once(
        lambda: judge(prepared, named, simulator, resamples, begin), simulated
    )
    missing = dict(study.candidates.missing)
    return DiagnosisResult(
        verdict=write_verdict(named, judged.gap, judged.remainder, judged.shares),
        causes=list_causes(study, named, judged.shares),
        remarks=list_remarks(named, judged.gap, judged.remainder, judged.detectable, list(missing)),
        simulator_kind="fitted" if simulator is None else simulator.kind,
        warnings=(
            *prepared.warnings,
            *(() if rendered else _simulator_warnings(study, named, given)),
        ),
        detected=named.tested and (bool(named.names) or judged.remainder.unknown),
        p_value=least_p_value(study, named.first),
        effects=named.names,
        cause_sets=named.cause_sets,
        likeliest=named.likeliest,
        refined_terms=named.refined_terms,
        tested=named.tested,
        where=judged.stages[1].found_where,
        outliers=prepared.outliers,
        ranking=rank_effects(study, named),
        missing=missing,
        simulator=with_effects,
        options=options,
        evidence=Evidence(study=study, named=named),
        **vars(judged),
        **vars(anew),
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
