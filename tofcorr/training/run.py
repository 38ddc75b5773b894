"""`tofcorr.train`: calibrate recordings of one camera; and its run folder, for later commands."""

import logging
import signal
import threading
from collections.abc import Callable, Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import dataclass
from functools import cached_property, partial
from pathlib import Path
from time import perf_counter
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from tofcorr.correction.corrector import DepthCorrector
from tofcorr.correction.export.torchscript import export_torchscript
from tofcorr.correction.state import (
    STATE_FILE,
    CalibrationState,
    load_calibration,
    save_calibration,
)
from tofcorr.errors import ConfigError, ExportError
from tofcorr.estimation.moments import Parameters
from tofcorr.estimation.solvers import Solution
from tofcorr.files import refuse_existing, staged_folder, write_json, write_text
from tofcorr.fit.known import PriorKnowledge
from tofcorr.fit.problem import Fit
from tofcorr.fit.reference import REFERENCE_FILE, estimate_reference, save_reference
from tofcorr.options import dump_yaml, resolve_options
from tofcorr.pixels.dataset import (
    Dataset,
    Recordings,
    opened,
    resolved_planes,
    split_frames,
)
from tofcorr.pixels.lattice import covered_domain, lattice_of
from tofcorr.pixels.passes import FittedModel, is_first, process_group
from tofcorr.pixels.sample import PixelSample, usable_pixels
from tofcorr.plausibility.examine import vet
from tofcorr.plausibility.finding import Inspection
from tofcorr.progress import stages
from tofcorr.training.calibration import Calibration, TrainingOptions, halves
from tofcorr.training.figures import frames_to_show, profile_figure, residual_figure
from tofcorr.training.judgement import (
    DO_NOT_USE,
    against_garbage,
    frames_left_out,
    full_text,
    report_text,
)
from tofcorr.training.monitor import RunMonitor
from tofcorr.training.pool import CameraType, load_type
from tofcorr.training.report import calibration_mapping, hand_eye_accuracy, training_report
from tofcorr.training.scene import (
    RuntimeOptions,
    scene_light,
    scene_summary,
    with_remainder,
)

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_LOG = logging.getLogger(__name__)


def calibration_state(
    data: Dataset, options: TrainingOptions, fit: Fit, *, learned: bool = True
) -> CalibrationState:
    """Return the calibration as the numbers that a corrector is built from.

    Args:
        data: The recordings.
        options: Of the training.
        fit: The fit.
        learned: Whether a network of what second bounces leave is trained, if options ask for it.
    """
    recording, parameters = data.first, fit.solution.parameters
    state = CalibrationState.of(
        fit.model.error,
        name=options.name,
        error_model=fit.options,
        domain=fit.domain,
        tool_from_camera=parameters.tool_from_camera,
        hand_eye_estimated=parameters.hand_eye_is_free,
        camera=recording.camera,
        depth_kind=recording.depth_kind,
        saturation_amplitude=recording.saturation_amplitude,
        covariance=fit.covariance.matrix[parameters.twist_size :, parameters.twist_size :],
        noise=None if fit.noise is None else fit.noise[:3],
        frames=recording.frame_names,
        hand_eye_accuracy=hand_eye_accuracy(fit),
        joint_covariance=fit.joint_covariance,
        residual_variance=fit.residual_variance,
    )
    state = state.model_copy(update={"scene": scene_light(data, options.runtime, state)})
    return with_remainder(options.runtime, state) if learned else state


def calibration_of(
    data: Dataset,
    options: TrainingOptions,
    fitted: Callable[..., Calibration],
    start: Parameters | None = None,
) -> Calibration:
    """Fit, and once more without second bounces if they are to be removed.

    Their gain is found beside the first fit, and again, of the frames as recorded, beside the last.

    Args:
        data: The recordings.
        options: Model and training.
        fitted: `Calibration`, with all else that it takes.
        start: Where the first fit starts; None: anew.
    """
    found = fitted(data, options, resumed=start)
    wanted = options.runtime.second_bounces
    if wanted is None:
        return found
    # How fast the corrector is does not matter yet.
    plain = {"second_bounces": wanted.model_copy(update={"budget_ms": None})}
    plain = {"runtime": options.runtime.model_copy(update=plain)}
    plain = options.model_copy(update=plain)
    state = calibration_state(found.data, plain, found.fit, learned=False)
    direct = data.without_second_bounces(state)
    return fitted(direct, options, resumed=found.fit.solution.parameters)


def resumed_parameters(run: Path | str, options: TrainingOptions) -> Parameters:
    """Return where the run in a folder stood.

    Raises:
        CalibrationDataError: The folder holds no run.
        ConfigError: The run was of another model.
    """
    state = load_calibration(Path(run) / STATE_FILE)
    if not state.error_model.same_coefficients(options.model):
        raise ConfigError(f"{run}: its model has other terms; resume with its own config.yaml.")
    return Parameters(state.tool_from_camera, state.coefficients, state.hand_eye_estimated)


@dataclass(frozen=True, kw_only=True, eq=False, repr=False)
class TrainingResult:
    """A training: what was fitted, how large its errors are, and what to know before using it.

    Attributes:
        report: The content of report.json; errors in millimetres.
        calibration: The fitted model and its errors in full.
        options: The options of the training.
        monitor: Every iteration of the solver, and when it ended.
        force: Whether a corrector is written whatever the verdict.
    """

    report: dict[str, Any]
    calibration: Calibration
    options: TrainingOptions
    monitor: RunMonitor
    force: bool = False

    def __post_init__(self) -> None:
        """Report what of the scene's light is removed, if anything was asked for."""
        if self.options.runtime != RuntimeOptions():
            model = FittedModel(self.fit.model, self.calibration.tested)
            self.report["scene"] = scene_summary(
                self.data, self.options.runtime, self._state, model
            )

    @property
    def iterations(self) -> tuple[Solution, ...]:
        """Every iteration of the solver."""
        return tuple(self.monitor.iterations)

    @property
    def fit(self) -> Fit:
        """The fitted model with its uncertainty."""
        return self.calibration.fit

    @property
    def data(self) -> Dataset:
        """The recordings; estimated walls stand in place of the recorded ones."""
        return self.calibration.data

    def corrector(self) -> DepthCorrector:
        """Return the corrector of this calibration, as `corrector.ts` holds it."""
        return DepthCorrector.from_state(self._state)

    def save(self, folder: Path | str) -> None:
        """Write the run folder, whole or not at all.

        Raises:
            CalibrationDataError: Something is there already, or it cannot be written.
        """
        with staged_folder(folder) as staged:
            self.write_into(staged)
        self.show_in(Path(folder))

    def write_into(self, folder: Path) -> None:
        """Write all files but TensorBoard's and the page into an existing folder."""
        fit, options, state = self.fit, self.options, self._state
        save_calibration(folder / STATE_FILE, state)
        reference = estimate_reference(self.data, self.calibration.frames, fit, state.noise)
        if reference is not None:
            save_reference(folder / REFERENCE_FILE, reference, state)
        if self.force or self.report["verdict"] != DO_NOT_USE:
            try:
                export_torchscript(DepthCorrector.from_state(state), folder / "corrector.ts", state)
            except ConfigError as missing:  # Of TorchScript in this torch.
                _LOG.warning("corrector.ts was not written: %s", missing)
        self.write_report(folder)
        text = dump_yaml(options.to_mapping(), last="model")
        (folder / "config.yaml").write_text(text, encoding="utf-8")
        text = dump_yaml(self._found)
        (folder / "calibration.yaml").write_text(text, encoding="utf-8")

    def write_report(self, folder: Path) -> None:
        """Write report.json, whole or not at all; an older one is replaced."""
        write_json(folder / "report.json", self.report, ExportError)

    def show_in(self, folder: Path) -> None:
        """Write the page of a run folder, unless figures are off, and TensorBoard's files."""
        figures, sample = {}, None
        if self.options.figures:
            from tofcorr.training.page import draw_figures, render

            sample = self._sample
            content = self.report, self.calibration, sample, self._found
            figures = draw_figures(*content)
            write_text(folder / "report.html", render(*content, figures))
        self.monitor.write(folder / "tb", self.calibration, self.report, sample, figures)

    def plot_profile(self, covariate: str = "distance") -> "Figure":
        """Draw mean and standard deviation of the error against a covariate.

        Args:
            covariate: `distance`, `amplitude`, `row`, `column` or `angle of incidence`.

        Raises:
            CalibrationDataError: The recording has no such covariate.
        """
        name = self._sample.covariate_named(covariate)
        return profile_figure(self._sample, [name], self.calibration.test)

    def plot_residuals(self) -> "Figure":
        """Draw the error images of some frames before and after correction.

        The frames range from the best corrected to the worst.
        """
        return residual_figure(self.calibration, frames_to_show(self.calibration))

    def __repr__(self) -> str:
        """Return verdict, errors, hand-eye and what would help most, as the command prints them."""
        return report_text(self.report)

    @property
    def details(self) -> str:
        """All that the training says of itself, with every warning."""
        return full_text(self.report)

    @cached_property
    def _state(self) -> CalibrationState:
        return calibration_state(self.data, self.options, self.fit)

    @cached_property
    def _found(self) -> dict[str, Any]:
        """The content of calibration.yaml."""
        found = calibration_mapping(self.data, self.options, self.fit, self.report)
        return found | {"scene": self._state.scene_mapping()}

    @cached_property
    def _sample(self) -> PixelSample:
        return PixelSample(self.data, self.calibration.stages, self.calibration.frames)


Config = str | Path | Mapping[str, Any] | TrainingOptions
"""A shipped configuration by name, a YAML file, its keys and values, or the options."""


@contextmanager
def interruptible() -> Iterator[list[int]]:
    """Collect Ctrl-C instead of raising KeyboardInterrupt, for the length of the block.

    Outside the main thread Python allows no handler: interruptions then reach the caller as usual.

    Yields:
        The signals received so far; empty until Ctrl-C is pressed.
    """
    received: list[int] = []
    if threading.current_thread() is not threading.main_thread():
        yield received
        return
    before = signal.signal(signal.SIGINT, lambda number, _: received.append(number))
    try:
        yield received
    finally:
        signal.signal(signal.SIGINT, before)


@contextmanager
def timed_stages(
    what: str, *, written: bool
) -> Iterator[tuple[Callable[[str], AbstractContextManager[None]], dict[str, float]]]:
    """Show which stage work is in, and measure each.

    Args:
        what: What is done.
        written: Whether files are written.

    Yields:
        What announces a stage and times a block; and the seconds of each stage so far.
    """
    seconds: dict[str, float] = {}
    # The bar counts read, inspect, fit and report; then write and figures.
    with stages(what, 6 if written else 4) as begin:

        @contextmanager
        def stage(name: str) -> Iterator[None]:
            """Announce a stage, and add up the seconds of the block, whatever ends it."""
            begin(name)
            start = perf_counter()
            try:
                yield
            finally:
                seconds[name] = round(seconds.get(name, 0.0) + perf_counter() - start, 3)

        yield stage, seconds


def inspected(
    data: Dataset, options: TrainingOptions, *, force: bool
) -> tuple[Dataset, TrainingOptions, Inspection, tuple[int, ...]]:
    """Look at recordings, and choose the pixels, weights and frames of a training.

    Args:
        data: The recordings.
        options: Of the training.
        force: Go on whatever the recordings look like.

    Returns:
        The recordings without the pixels that are left out; the options, with robust weights where
        garbage spoils a fit; what was odd; and global numbers of frames that no fit uses.

    Raises:
        CalibrationDataError: The recordings cannot be what they say.
    """
    inspection = vet(data, resolved_planes(options.planes, data.recordings), force=force)
    options = against_garbage(options, inspection)
    frames, _ = split_frames(data, options.split)
    left_out = frames_left_out(inspection, [frames])
    robust = options.weights.robust != "none"
    data = usable_pixels(data, options, robust=robust, frames=frames)
    return data, options, inspection, left_out


def train(
    recordings: Recordings,
    config: Config = "ea",
    *,
    out: Path | str | None = None,
    resume: Path | str | None = None,
    prior: Path | str | None = None,
    force: bool = False,
) -> TrainingResult:
    """Fit an error model and the hand-eye transform to recordings of one camera.

    A share of the poses is held out, as the configuration says. Ctrl-C ends the fit early: the
    result then says `interrupted`, and holds the best parameters so far.

    Args:
        recordings: A folder, a `Recording`, or several of either.
        config: A shipped configuration by name, a YAML file, its keys and values, or the options.
        out: Folder of the run, written whole or not at all; nothing may be there yet. The page
            and files for TensorBoard follow once it is there. None writes nothing;
            `TrainingResult.save` does later.
        resume: Folder of an interrupted run of the same model; the fit goes on where it stood.
        prior: File of `tofcorr.pool`: what other cameras of this type have in common. Fewer poses
            are then enough.
        force: Fit whatever the recordings look like, and write a corrector whatever the verdict.

    Returns:
        The fitted model with its report; its `repr` is what the command prints.

    Raises:
        ConfigError: The configuration is wrong, or `resume` or `prior` are of another model.
        CalibrationDataError: The recordings cannot support the model, or cannot be what they say
            (see `tofcorr.inspect`); `out` exists, `resume` holds no run, or `prior` is no file of
            `tofcorr.pool` or is of a camera of another image size.
    """
    options, carry = resolve_options(TrainingOptions, config), None
    if prior is not None:
        of_type = load_type(prior, options)
        options = options.model_copy(update={"model": of_type.error_model})
        carry = partial(_of_type, of_type)
    return carried_training(recordings, options, carry, out=out, resume=resume, force=force)


class Carried(NamedTuple):
    """What a training knows before its fit.

    Attributes:
        data: The recordings.
        known: What earlier calibrations say, for the ranges of the fit; None: nothing.
        said: Returns what the report says of it, by its key, from the fit.
    """

    data: Dataset
    known: PriorKnowledge | None
    said: Callable[[Fit], dict[str, Any]]


Carry = Callable[[Dataset, TrainingOptions, np.ndarray], Carried]
"""Returns what is known before a fit to some frames of recordings."""


def _of_type(
    of_type: CameraType, data: Dataset, options: TrainingOptions, frames: np.ndarray
) -> Carried:
    """Return what other cameras of the type say."""
    known = of_type.known(data).towards(covered_domain(data, frames, lattice_of(data, frames)))
    return Carried(data, known, lambda fit: {"prior": {"units": list(of_type.units)}})


def carried_training(
    recordings: Recordings,
    options: TrainingOptions,
    carry: Carry | None,
    *,
    out: Path | str | None,
    resume: Path | str | None = None,
    force: bool = False,
) -> TrainingResult:
    """Train as `train` does, with what is known before; None: nothing."""
    if out is not None:
        refuse_existing(Path(out))
    with timed_stages("training", written=out is not None) as (stage, seconds):
        with stage("read"):
            data = Dataset(opened(recordings))
            data = data.without_stray_light(options.runtime.stray_light)
            start = None if resume is None else resumed_parameters(resume, options)
        with stage("inspect"):
            data, options, inspection, left_out = inspected(data, options, force=force)
        with process_group(options.device) as device, interruptible() as interrupted:
            # Every process fits, so that none waits; only the first one watches and writes.
            place = Path(out) if out is not None and is_first() else None
            with staged_folder(place) if place else nullcontext() as folder:
                monitor = RunMonitor()

                def watch(iteration: Solution) -> bool:
                    monitor.iteration(iteration)
                    return not interrupted

                local = options.model_copy(update={"device": device})
                with stage("fit"):
                    before = carry and carry(data, local, halves(data, local, left_out)[0])
                    data, known = (data, None) if before is None else before[:2]
                    own = partial(Calibration, watcher=watch, left_out=left_out, known=known)
                    calibration = calibration_of(data, local, own, start)
                with stage("report"):
                    report = training_report(calibration, options, inspection)
                    report |= {} if before is None else before.said(calibration.fit)
                    result = TrainingResult(
                        report=report | {"seconds": seconds},
                        calibration=calibration,
                        options=options,
                        monitor=monitor,
                        force=force,
                    )
                if folder:
                    with stage("write"):
                        result.write_into(folder)
        # The run is on disk; what only helps to look at it follows.
        if place:
            try:
                with stage("figures"):
                    result.show_in(place)
                result.write_report(place)
            except (OSError, ExportError) as error:
                _LOG.warning(
                    "%s is whole; its page or files for TensorBoard are not: %s", out, error
                )
        return result
