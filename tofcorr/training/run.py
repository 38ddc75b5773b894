"""`tofcorr.train`: calibrate recordings of one camera."""

import logging
import signal
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, nullcontext
from pathlib import Path
from time import perf_counter
from types import FrameType
from typing import Any

from tofcorr.errors import ExportError
from tofcorr.estimation.solvers import Solution
from tofcorr.files import StagedFolder, refuse_existing
from tofcorr.options import resolve_options
from tofcorr.pixels.dataset import Dataset, Recordings, opened, resolved_planes, split_frames
from tofcorr.pixels.distributed import alone, is_first, process_group
from tofcorr.pixels.sample import usable_pixels
from tofcorr.plausibility.examine import vet
from tofcorr.progress import stages
from tofcorr.training.calibration import calibrate
from tofcorr.training.judgement import against_garbage, frames_left_out
from tofcorr.training.monitor import RunMonitor
from tofcorr.training.options import TrainingOptions
from tofcorr.training.report import training_report
from tofcorr.training.result import TrainingResult, resumed_parameters, write_report


class Stopwatch:
    """Adds up the seconds of named stages.

    Args:
        announce: Called with the name of each stage as it begins.

    Attributes:
        seconds: By stage, in the order of the first start, to the millisecond.
    """

    def __init__(self, announce: Callable[[str], object] = lambda name: None) -> None:
        self._announce = announce
        self.seconds: dict[str, float] = {}

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Add the time of the block to a stage, whatever ends it."""
        self._announce(name)
        start = perf_counter()
        try:
            yield
        finally:
            spent = self.seconds.get(name, 0.0) + perf_counter() - start
            self.seconds[name] = round(spent, 3)


@contextmanager
def interruptible() -> Iterator[list[int]]:
    """Collect Ctrl-C instead of raising KeyboardInterrupt, for the length of the block.

    Outside the main thread Python allows no handler: interruptions then reach the caller as usual.

    Yields:
        The signals received so far; empty until Ctrl-C is pressed.
    """
    received: list[int] = []

    def note(number: int, _: FrameType | None) -> None:
        received.append(number)

    try:
        before = signal.signal(signal.SIGINT, note)
    except ValueError:
        yield received
        return
    try:
        yield received
    finally:
        signal.signal(signal.SIGINT, before)


_LOG = logging.getLogger(__name__)

# Stages that the progress bar counts: read, inspect, read, fit, report; then write and figures.
_STAGES, _STAGES_WRITTEN = 5, 7

Config = str | Path | Mapping[str, Any] | TrainingOptions
"""A shipped configuration by name, a YAML file, its keys and values, or the options."""


def train(
    recordings: Recordings,
    config: Config = "ea",
    *,
    out: Path | str | None = None,
    resume: Path | str | None = None,
    force: bool = False,
) -> TrainingResult:
    """Fit an error model and the hand-eye transform to recordings of one camera.

    A share of the poses is held out, as the configuration says. Ctrl-C ends the fit early: the
    result then says `interrupted`, and holds the best parameters so far.

    Args:
        recordings: A folder, a `Recording`, or several of either.
        config: A shipped configuration by name, a YAML file, its keys and values, or the options.
        out: Folder of the run, written whole or not at all; nothing may be there yet. Files for
            TensorBoard follow once it is there. None writes nothing; `TrainingResult.save` does
            later.
        resume: Folder of an interrupted run of the same model; the fit goes on where it stood.
        force: Fit whatever the recordings look like, and write a corrector whatever the verdict.

    Returns:
        The fitted model with its report; its `repr` is what the command prints.

    Raises:
        ConfigError: The configuration is wrong, or `resume` is a run of another model.
        CalibrationDataError: The recordings cannot support the model, or cannot be what they say
            (see `tofcorr.inspect`); `out` exists, or `resume` holds no run.
    """
    options = resolve_options(TrainingOptions, config)
    if out is not None:
        refuse_existing(Path(out))
    with stages("training", _STAGES if out is None else _STAGES_WRITTEN) as begin:
        return _train(recordings, options, out, resume, Stopwatch(begin), force=force)


def _train(
    recordings: Recordings,
    options: TrainingOptions,
    out: Path | str | None,
    resume: Path | str | None,
    clock: Stopwatch,
    *,
    force: bool,
) -> TrainingResult:
    with clock.stage("read"):
        data = Dataset(opened(recordings))
        start = None if resume is None else resumed_parameters(resume, options)
    with clock.stage("inspect"):
        inspection = vet(data, resolved_planes(options.planes, data.recordings), force=force)
        options = against_garbage(options, inspection)
        left_out = frames_left_out(inspection, [split_frames(data, options.split)[0]])
    with clock.stage("read"):
        data = usable_pixels(
            data,
            options,
            robust=options.weights.robust != "none",
            frames=split_frames(data, options.split)[0],
        )
    with process_group(options.device) as device, interruptible() as interrupted:
        # Every process fits, so that none waits; only the first one watches and writes.
        stage = StagedFolder(out) if out is not None and is_first() else None
        with stage or nullcontext():
            monitor = RunMonitor()

            def watch(iteration: Solution) -> bool:
                monitor.iteration(iteration)
                return not interrupted

            local = options.model_copy(update={"device": device})
            with clock.stage("fit"):
                calibration = calibrate(data, local, watch, start, left_out)
            with clock.stage("report"):
                report = training_report(calibration, options, inspection)
            result = TrainingResult(
                report=report | {"seconds": clock.seconds},
                calibration=calibration,
                options=options,
                iterations=tuple(monitor.iterations),
                force=force,
            )
            if stage:
                with alone(), clock.stage("write"):
                    result.write_into(stage.folder)
    # The run is on disk; what only helps to look at it follows.
    if stage:
        try:
            with clock.stage("figures"):
                result.show_in(stage.path, monitor)
            write_report(stage.path, result.report)
        except (OSError, ExportError) as error:
            _LOG.warning("%s is whole; its files for TensorBoard are not: %s", out, error)
    return result
