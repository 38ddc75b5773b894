"""Writes the course of a calibration for TensorBoard, with curves and error images."""

import math
import sys
import time
from collections.abc import Iterator, Mapping
from pathlib import Path
from textwrap import wrap
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from tofcorr.estimation.moments import Parameters
from tofcorr.estimation.regularisation import total_weight
from tofcorr.estimation.robust import without_strays
from tofcorr.estimation.solvers import Solution
from tofcorr.geometry import se3
from tofcorr.pixels.sample import PixelSample
from tofcorr.progress import event_writer
from tofcorr.training.calibration import Calibration
from tofcorr.training.figures import profile
from tofcorr.training.judgement import full_text

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from torch.utils.tensorboard import SummaryWriter


class RunMonitor:
    """Remembers the course of a run, and writes it for TensorBoard once the run is on disk.

    `iteration` is a `Watcher`: pass it to `Calibration`.

    Attributes:
        iterations: Every iteration of the solver so far.

    Example:
        monitor = RunMonitor()
        calibration = Calibration(data, options, watcher=monitor.iteration)
        monitor.write(run / "tb", calibration, report, sample, figures)
    """

    def __init__(self) -> None:
        self.iterations: list[Solution] = []
        self._times: list[float] = []

    def iteration(self, iteration: Solution) -> None:
        """Record one iteration of the solver; never interrupts it."""
        self.iterations.append(iteration)
        self._times.append(time.time())

    def write(
        self,
        folder: Path,
        calibration: Calibration,
        report: Mapping[str, Any],
        sample: PixelSample | None,
        figures: Mapping[str, "Figure"],
    ) -> None:
        """Write TensorBoard's files.

        Args:
            folder: Where the event files go, usually RUN/tb; made if it is missing.
            calibration: The fitted model and its errors.
            report: The content of report.json, to be shown as text.
            sample: Pixels whose errors are shown as curves and distributions; None: neither.
            figures: Pictures of the run by name.
        """
        with event_writer(folder) as writer:
            # TensorBoard shows groups in the order of their names: the result comes first.
            # A point each: TensorBoard smooths what stands in one curve.
            for step, (stage, halves) in enumerate(report["error_mm"].items()):
                for half, error in zip(("fitted", "held_out"), halves.values(), strict=True):
                    if error["rms"] is not None:
                        writer.add_scalar(f"1_result/rms_mm_{half}_{step}_{stage}", error["rms"])
            for values in self._scalars(calibration):
                writer.add_scalar(*values)
            # Four spaces keep the lines of a table as they are.
            lines = [wrap(line, 100) for line in full_text(report).splitlines()]
            writer.add_text("report", "\n".join(f"    {part}" for line in lines for part in line))
            if sample is not None:
                _write_errors(writer, calibration, sample)
            for name, figure in figures.items():
                from tofcorr.pages.drawing import raster  # With it comes matplotlib.

                writer.add_image(f"1_result/picture_{name}", raster(figure), dataformats="HWC")

    def _scalars(self, calibration: Calibration) -> Iterator[tuple[str, float, int, float]]:
        """Yield tag, value, iteration and time of every number.

        One step further than the last iteration stands the estimate, which the noise's shift was
        taken off.
        """
        if not self.iterations:
            return
        moments, before = calibration.fit.moments, self.iterations[0].parameters.tool_from_camera
        moved = ("t_x_mm", "t_y_mm", "t_z_mm", "rotation_deg")
        tags = [f"hand_eye_since_start/{name}" for name in moved]
        # TensorBoard allows no ^ in a tag; c^1 of the column must not become c1.
        tags += [f"coefficients_mm/{name.replace('^', '_to_the_')}" for name in moments.symbols]

        def state(now: Parameters) -> dict[str, float]:
            after = now.tool_from_camera
            shift = (1e3 * (after - before)[:3, 3]).tolist()
            turned = torch.rad2deg(se3.rotation_angle(before[:3, :3].T @ after[:3, :3]))
            values = [*shift, float(turned), *(1e3 * now.coefficients).tolist()]
            return dict(zip(tags, values, strict=True))

        for iteration, when in zip(self.iterations, self._times, strict=True):
            loss, left = iteration.loss, math.log10(max(iteration.step_left, sys.float_info.min))
            own = {"convergence/loss_m2": loss, "convergence/log10_step_left_se": left}
            own["convergence/rms_mm"] = 1e3 * max(loss / total_weight(moments), 0.0) ** 0.5
            for tag, value in (own | state(iteration.parameters)).items():
                yield tag, value, iteration.iterations, when
        for tag, value in state(calibration.fit.solution.parameters).items():
            yield tag, value, self.iterations[-1].iterations + 1, self._times[-1]


def _write_errors(writer: "SummaryWriter", calibration: Calibration, sample: PixelSample) -> None:
    """Write curves of the error over each covariate, and distributions."""
    tested = np.isin(sample.frame, calibration.test)
    for covariate, x in sample.covariates.items():
        low, high = ends = without_strays(x)
        # TensorBoard counts steps in whole numbers, so a covariate is multiplied by the power of
        # ten that the tag names, until its range has 300 of them: bins stay apart.
        power = max(math.ceil(math.log10(300 / max(high - low, sys.float_info.epsilon))), 0)
        name = covariate.split(" [")[0].replace(" ", "_")
        name += f"_x{10**power}" if power else ""
        shown = {stage: (x, error) for stage, error in sample.errors_mm.items()}
        if tested.any() and "after" in shown:
            shown["after_held_out"] = x[tested], sample.errors_mm["after"][tested]
        for stage, (at, error) in shown.items():
            middle, mean, _ = profile(at, error, ends)
            known = np.isfinite(mean)
            for place, value in zip(middle[known], mean[known], strict=True):
                step = round(place * 10**power)
                writer.add_scalar(f"error_mm_against/{name}/{stage}", value, step)
    for stage, errors in sample.errors_mm.items():
        for half, chosen in (("fitted", ~tested), ("held_out", tested)):
            known = errors[chosen & np.isfinite(errors)]
            if len(known):
                writer.add_histogram(f"error_mm/{stage}_{half}", known)
