"""A training and its run folder: everything that later commands read."""

import json
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from tofcorr.correction.corrector import DepthCorrector
from tofcorr.correction.export.torchscript import export_torchscript
from tofcorr.correction.state import (
    STATE_FILE,
    CalibrationState,
    ResidualState,
    load_calibration,
    save_calibration,
)
from tofcorr.errors import CalibrationDataError, ConfigError
from tofcorr.estimation.moments import Parameters
from tofcorr.estimation.solvers import Solution
from tofcorr.files import StagedFolder, staged_file
from tofcorr.fit.reference import REFERENCE_FILE, Reference, estimate_reference, save_reference
from tofcorr.fit.result import Fit
from tofcorr.options import dump_yaml
from tofcorr.pixels.dataset import Dataset
from tofcorr.pixels.sample import PixelSample, sample_pixels
from tofcorr.training import shown
from tofcorr.training.calibration import Calibration
from tofcorr.training.judgement import DO_NOT_USE, report_text
from tofcorr.training.monitor import RunMonitor
from tofcorr.training.options import TrainingOptions
from tofcorr.training.report import calibration_mapping, hand_eye_accuracy

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def write_run(
    folder: Path,
    calibration: Calibration,
    options: TrainingOptions,
    report: Mapping[str, Any],
    *,
    corrector: bool = True,
) -> None:
    """Write all files of a run into an existing folder, except TensorBoard's.

    Args:
        folder: Where the files go.
        calibration: The fitted model.
        options: Those of the training.
        report: The content of report.json.
        corrector: Whether to write corrector.ts.
    """
    data, fit = calibration.data, calibration.fit
    state = calibration_state(data, options, fit)
    save_calibration(folder / STATE_FILE, state)
    reference = run_reference(calibration, state)
    if reference is not None:
        save_reference(folder / REFERENCE_FILE, reference, state)
    if corrector:
        export_torchscript(DepthCorrector.from_state(state), folder / "corrector.ts", state)
    write_report(folder, report)
    text = dump_yaml(options.to_mapping(), last="model")
    (folder / "config.yaml").write_text(text, encoding="utf-8")
    values = calibration_mapping(data, options, fit, report)
    (folder / "calibration.yaml").write_text(dump_yaml(values), encoding="utf-8")


def run_reference(calibration: Calibration, state: CalibrationState) -> Reference | None:
    """Return what a later check must know of the frames, fitted and held out; None: unknown."""
    fit = calibration.fit
    return estimate_reference(
        calibration.data,
        np.sort(np.concatenate([calibration.train, calibration.test])),
        fit.model,
        fit.domain,
        state.noise,
        twist=state.hand_eye_estimated,
        walls_are_known=fit.walls is None,
    )


def write_report(folder: Path, report: Mapping[str, Any]) -> None:
    """Write report.json, whole or not at all; an older one is replaced."""
    text = json.dumps(dict(report), indent=1, allow_nan=False) + "\n"
    with staged_file(folder / "report.json") as part:
        part.write_text(text, encoding="utf-8")


def calibration_state(data: Dataset, options: TrainingOptions, fit: Fit) -> CalibrationState:
    """Return the calibration as the numbers that a corrector is built from."""
    recording, error, parameters = data.first, fit.model.error, fit.solution.parameters
    network = None
    if error.residual is not None and options.residual is not None:
        weights = error.residual.weight_vector()
        network = ResidualState(options=options.residual.network, weights=weights)
    return CalibrationState(
        name=options.name,
        error_model=fit.options,
        domain=fit.domain,
        coefficients=parameters.coefficients,
        tool_from_camera=parameters.tool_from_camera,
        hand_eye_estimated=parameters.hand_eye_is_free,
        camera=recording.camera,
        depth_kind=recording.depth_kind,
        saturation_amplitude=recording.saturation_amplitude,
        fixed_pattern=error.fixed_pattern.offset if error.fixed_pattern is not None else None,
        residual=network,
        covariance=fit.covariance.matrix[parameters.twist_size :, parameters.twist_size :],
        noise=None if fit.noise is None else fit.noise.coefficients,
        frames=recording.frame_names,
        hand_eye_accuracy=hand_eye_accuracy(fit),
    )


def resumed_parameters(run: Path | str, options: TrainingOptions) -> Parameters:
    """Return where the run in a folder stood.

    Raises:
        CalibrationDataError: The folder holds no run.
        ConfigError: The run was of another model.
    """
    path = Path(run) / STATE_FILE
    if not path.is_file():
        raise CalibrationDataError(f"{path}: there is no such file; is {run} a run of tofcorr?")
    state = load_calibration(path)
    if not state.error_model.same_coefficients(options.model):
        raise ConfigError(
            f"{run}: its model has other terms than the configuration asks for; resume with the "
            "configuration of that run, its config.yaml."
        )
    return Parameters(state.tool_from_camera, state.coefficients, state.hand_eye_estimated)


@dataclass(frozen=True, kw_only=True, eq=False, repr=False)
class TrainingResult:
    """A training: what was fitted, how large its errors are, and what to know before using it.

    Attributes:
        report: The content of report.json; errors in millimetres.
        calibration: The fitted model and its errors in full.
        options: The options of the training.
        iterations: Every iteration of the solver.
        force: Whether a corrector is written whatever the verdict.
    """

    report: Mapping[str, Any]
    calibration: Calibration
    options: TrainingOptions
    iterations: tuple[Solution, ...]
    force: bool = False

    @property
    def fit(self) -> Fit:
        """The fitted model with its uncertainty."""
        return self.calibration.fit

    @property
    def data(self) -> Dataset:
        """The recordings; estimated walls stand in place of the recorded ones."""
        return self.calibration.data

    @property
    def has_corrector(self) -> bool:
        """Whether the run folder holds a corrector: not if the verdict is `do not use`."""
        return self.force or self.report["verdict"] != DO_NOT_USE

    def corrector(self) -> DepthCorrector:
        """Return the corrector of this calibration, as `corrector.ts` holds it."""
        return DepthCorrector.from_state(calibration_state(self.data, self.options, self.fit))

    def save(self, folder: Path | str) -> None:
        """Write the run folder, whole or not at all.

        Raises:
            CalibrationDataError: Something is there already, or it cannot be written.
        """
        with StagedFolder(folder) as stage:
            self.write_into(stage.folder)
        monitor = RunMonitor()
        for iteration in self.iterations:
            monitor.iteration(iteration)
        self.show_in(stage.path, monitor)

    def write_into(self, folder: Path) -> None:
        """Write all files but TensorBoard's into an existing folder."""
        write_run(folder, self.calibration, self.options, self.report, corrector=self.has_corrector)

    def show_in(self, folder: Path, monitor: RunMonitor) -> None:
        """Write TensorBoard's files of a run folder, from a monitor of the iterations."""
        figures = self.options.figures
        monitor.write(folder / "tb", self.calibration, self.report, figures=figures)

    def plot_profile(self, covariate: str = "distance") -> "Figure":
        """Draw mean and standard deviation of the error against a covariate.

        Args:
            covariate: `distance`, `amplitude`, `row`, `column` or `angle of incidence`.

        Raises:
            CalibrationDataError: The recording has no such covariate.
        """
        from tofcorr.training.figures import profile_figure

        name = self._sample.covariate_named(covariate)
        return profile_figure(self._sample, name, self.calibration.test)

    def plot_residuals(self) -> "Figure":
        """Draw the error images of some frames before and after correction.

        The frames range from the best corrected to the worst.
        """
        from tofcorr.training.figures import residual_figure

        chosen = shown.frames_to_show(self.calibration)
        return residual_figure(*shown.error_images(self.calibration, chosen))

    def plot_points(self, frame: int) -> "Figure":
        """Draw the points of one frame on its plane at each stage, their distance stretched.

        Args:
            frame: Global number of the frame, over all recordings.
        """
        from tofcorr.training.figures import points_figure

        return points_figure(*shown.points_on_plane(self.calibration, frame))

    def __repr__(self) -> str:
        """Return errors, hand-eye translation, advice and warnings, as the command prints them."""
        return report_text(self.report)

    @cached_property
    def _sample(self) -> PixelSample:
        frames = np.sort(np.concatenate([self.calibration.train, self.calibration.test]))
        return sample_pixels(self.data, self.calibration.stages, frames)
