"""What a training returns: the report, the fitted model, figures, and the run folder on request."""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from tofcorr.correction.corrector import DepthCorrector
from tofcorr.estimation.solution import Iteration
from tofcorr.files.staged import StagedFolder
from tofcorr.fit.result import Fit
from tofcorr.pixels.dataset import Dataset
from tofcorr.pixels.pixel_sample import PixelSample, sample_pixels
from tofcorr.training import shown
from tofcorr.training.calibration import Calibration
from tofcorr.training.folder import calibration_state, write_run
from tofcorr.training.monitor import RunMonitor
from tofcorr.training.options import TrainingOptions
from tofcorr.training.text import report_text
from tofcorr.training.verdict import DO_NOT_USE

if TYPE_CHECKING:
    from matplotlib.figure import Figure


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
    iterations: tuple[Iteration, ...]
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
