"""The whole diagnosis of one recording, step by step."""

from collections.abc import Callable, Mapping
from contextlib import ExitStack, nullcontext
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from tofcorr.data.recording import Recording
from tofcorr.diagnosis.findings.impossible import (
    Oddities,
    headline_of_given,
    refuse_impossible_gap,
)
from tofcorr.diagnosis.given.simulator import GivenSimulator
from tofcorr.diagnosis.given.source import Simulator, open_simulator
from tofcorr.diagnosis.options import DiagnosisOptions
from tofcorr.diagnosis.prepare import Prepared, prepare
from tofcorr.estimation.solvable import solvable
from tofcorr.files.staged import StagedFolder
from tofcorr.options import resolve_options
from tofcorr.pixels.dataset import Dataset
from tofcorr.pixels.done_by_a_copy import done_by_a_copy
from tofcorr.pixels.imported_beside import imported_beside
from tofcorr.pixels.plane_choice import resolved_planes
from tofcorr.pixels.thread_number import thread_number
from tofcorr.pixels.two_at_once import two_processes
from tofcorr.plausibility.examine import vet
from tofcorr.progress import stages

if TYPE_CHECKING:
    from tofcorr.diagnosis.report.result import DiagnosisResult

# What the findings and the page need and the sums do not. Together they take two thirds of the time
# of torch to import.
_FOR_FINDINGS = (
    "scipy.special",
    "scipy.optimize",
    "scipy.interpolate",
    "tofcorr.diagnosis.conclude",
    "tofcorr.diagnosis.report.write",
)
_FOR_THE_PAGE = (
    "tofcorr.diagnosis.report.page",
    "tofcorr.diagnosis.report.figures",
    "tofcorr.diagnosis.report.monitor",
)
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
) -> "DiagnosisResult":
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
            exists or cannot be written.
    """
    # First of all: what cannot be written is refused before any work.
    with StagedFolder(out) if out is not None else nullcontext() as stage:
        if not isinstance(recording, Recording):
            recording = Recording.open(Path(recording))
        simulator = open_simulator(sim)
        options = (
            DiagnosisOptions() if config is None else resolve_options(DiagnosisOptions, config)
        )
        folder = None if stage is None else stage.folder
        return _diagnosed(recording, simulator, options, folder, force=force, may_copy=may_copy)


def _diagnosed(
    recording: Recording,
    simulator: GivenSimulator | None,
    options: DiagnosisOptions,
    folder: Path | None,
    *,
    force: bool,
    may_copy: bool,
) -> "DiagnosisResult":
    """Return the findings, and write the report into a folder if one is given."""
    later = (*_FOR_FINDINGS, *(_FOR_THE_PAGE if folder is not None and options.page else ()))
    total = _STAGES if folder is None else _STAGES + 1

    def inspected() -> Oddities:
        data, planes = Dataset((recording,)), resolved_planes("auto", [recording])
        return Oddities.of(vet(data, planes, force=force))

    with thread_number(options.threads), ExitStack() as beside:
        odd = beside.enter_context(done_by_a_copy(inspected, may_copy))
        beside.enter_context(imported_beside(later, may_copy))
        with stages("diagnosing", total) as begin, solvable(recording.path, "diagnosis"):
            begin("fitting the base model")
            prepared = prepare(recording, options, simulator)
            oddities = odd()
            if not force:
                refuse_impossible_gap(prepared.study, oddities)
            beside.close()
            return _concluded(prepared, simulator, oddities, begin, folder, may_copy=may_copy)


def _concluded(
    prepared: Prepared,
    simulator: GivenSimulator | None,
    oddities: Oddities,
    begin: Callable[[str], object],
    folder: Path | None,
    *,
    may_copy: bool,
) -> "DiagnosisResult":
    """Return the findings, and write the report if it is wanted."""
    # Imported beside the steps before.
    from tofcorr.diagnosis.conclude import conclude
    from tofcorr.diagnosis.report.write import texts_of, write_report

    texts = None
    with two_processes(may_copy, (prepared.study.observations.recording,)):
        result = conclude(prepared, simulator, begin)
        first = [oddities.headline, headline_of_given(result.gap.as_given), result.verdict]
        result = replace(result, verdict=" ".join(sentence for sentence in first if sentence))
        if folder is not None:
            begin("writing the report")
            texts = texts_of(result)
    if folder is not None and texts is not None:
        write_report(result, folder, texts)
    return result
