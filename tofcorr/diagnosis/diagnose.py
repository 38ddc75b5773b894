"""The whole diagnosis of one recording, step by step."""

from collections.abc import Mapping
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from typing import Any

from tofcorr.data.recording import Recording
from tofcorr.diagnosis.conclude import conclude
from tofcorr.diagnosis.findings.impossible import (
    headline_of_given,
    refuse_impossible_gap,
)
from tofcorr.diagnosis.given.source import Simulator, open_simulator
from tofcorr.diagnosis.options import DiagnosisOptions
from tofcorr.diagnosis.prepare import prepare
from tofcorr.diagnosis.report.page import write_report
from tofcorr.diagnosis.report.result import DiagnosisResult
from tofcorr.estimation.linear import solvable
from tofcorr.files import StagedFolder
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
        with (
            thread_number(options.threads),
            stages("diagnosing", 5 if stage is None else 6) as begin,
            solvable(recording.path, "diagnosis"),
        ):
            begin("fitting the base model")
            planes = resolved_planes("auto", [recording])
            inspection = vet(Dataset((recording,)), planes, force=force)
            prepared = prepare(recording, options, simulator)
            if not force:
                refuse_impossible_gap(prepared.study, inspection)
            result = conclude(prepared, simulator, begin)
            first = [inspection.headline, headline_of_given(result.gap.as_given), result.verdict]
            result = replace(result, verdict=" ".join(filter(None, first)))
            if stage is not None:
                begin("writing the report")
                write_report(result, stage.folder)
        return result
