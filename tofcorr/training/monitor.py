"""Writes the course of a calibration for TensorBoard."""

import math
from collections.abc import Iterator, Mapping
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import numpy as np
import torch
from matplotlib.figure import Figure
from torch import Tensor
from torch.utils.tensorboard import SummaryWriter

from tofcorr.estimation.moments import ImageMoments
from tofcorr.estimation.objective import residual_vectors
from tofcorr.estimation.parameters import Parameters
from tofcorr.estimation.solution import Iteration
from tofcorr.fit.result import Fit
from tofcorr.geometry import se3
from tofcorr.pixels.pixel_sample import sample_pixels
from tofcorr.training.calibration import Calibration
from tofcorr.training.figures import pixels_of, points_figure, profile_figure, residual_figure
from tofcorr.training.shown import error_images, frames_to_show, points_on_plane


class RunMonitor:
    """Writes what happens in a run for TensorBoard.

    `iteration` is a `Watcher`: pass it to `calibrate`. `finish` is called once, after the fit.

    Args:
        folder: Where the event files go, usually RUN/tb; made if it is missing.

    Example:
        with RunMonitor(run / "tb") as monitor:
            calibration = calibrate(data, options, watcher=monitor.iteration)
            monitor.finish(calibration, report)
    """

    def __init__(self, folder: Path | str) -> None:
        self._writer = SummaryWriter(str(folder))
        self._iterations: list[Iteration] = []

    def iteration(self, iteration: Iteration) -> None:
        """Record one iteration of the solver; never interrupts it."""
        self._iterations.append(iteration)
        number = iteration.number
        self._writer.add_scalar("convergence/loss_m2", iteration.loss, number)
        step_left = math.log10(max(iteration.step_left, 1e-300))
        self._writer.add_scalar("convergence/log10_step_left_se", step_left, number)
        start = self._iterations[0].parameters.tool_from_camera
        now = iteration.parameters.tool_from_camera
        for axis, moved in zip("xyz", (now - start)[:3, 3].tolist(), strict=True):
            self._writer.add_scalar(f"hand_eye_since_start/t_{axis}_mm", 1e3 * moved, number)
        turned = torch.rad2deg(se3.rotation_angle(start[:3, :3].T @ now[:3, :3]))
        self._writer.add_scalar("hand_eye_since_start/rotation_deg", float(turned), number)

    def finish(self, calibration: Calibration, report: Mapping[str, Any] | None = None) -> None:
        """Record what can only be shown after the fit.

        Args:
            calibration: The fitted model and its errors.
            report: The content of report.json, to be shown as text.
        """
        data, train, test = calibration.data, calibration.train, calibration.test
        self._loss_parts(calibration.fit.moments, data.targets[train])
        self._coefficients(calibration.fit)
        sample = sample_pixels(data, calibration.stages, np.sort(np.concatenate([train, test])))
        for covariate in sample.covariates:
            name = covariate.split(" [")[0].replace(" ", "_")
            self._figure(f"error_against/{name}", profile_figure(sample, covariate, test))
        chosen = frames_to_show(calibration)
        residuals = residual_figure(*error_images(calibration, chosen))
        self._figure("frames/error_before_and_after", residuals)
        points = points_figure(*points_on_plane(calibration, int(chosen[len(chosen) // 2])))
        self._figure("frames/points_before_and_after", points)
        if report:
            self._writer.add_text("report", "\n\n".join(_in_markdown(report)))

    def close(self) -> None:
        """Write what is still buffered, and close the files."""
        self._writer.close()

    def __enter__(self) -> Self:
        """Return the monitor."""
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        """Close the files, whatever happened."""
        self.close()

    def _loss_parts(self, moments: ImageMoments, targets: np.ndarray) -> None:
        """Record the loss as RMS distances in mm: of all pixels, within and between images."""
        for iteration in self._iterations:
            shares = loss_parts(moments, iteration.parameters, targets)
            for name, value in shares.items():
                self._writer.add_scalar(f"rms_mm/{name}", value, iteration.number)

    def _coefficients(self, fit: Fit) -> None:
        for iteration in self._iterations:
            values = iteration.parameters.coefficients.tolist()
            for symbol, value in zip(fit.moments.symbols, values, strict=True):
                # TensorBoard allows no ^ in a tag; c^1 of the column must not become c1.
                tag = symbol.replace("^", "_to_the_")
                self._writer.add_scalar(f"coefficients_mm/{tag}", 1e3 * value, iteration.number)

    def _figure(self, tag: str, figure: Figure) -> None:
        self._writer.add_image(tag, pixels_of(figure), dataformats="HWC")


def loss_parts(
    moments: ImageMoments, parameters: Parameters, targets: np.ndarray
) -> dict[str, float]:
    """Split the loss by target, and into a share between images and a share within them.

    The share between images is that of the images' mean residuals, which errors of pose, hand-eye
    and plane cause. The share within is that of the residuals less each image's mean. The squares
    of both add up to that of `all`.

    Args:
        moments: Moments of the images.
        parameters: Where to evaluate the loss.
        targets: Each image's target, shape (N,), text.

    Returns:
        Root mean square distances to the plane in mm: `all`, `between_images`, `within_images`,
        and `target_NAME` for each target.
    """
    p = residual_vectors(moments, parameters)
    by_pixel = torch.einsum("nqr,nr->nq", moments.gram, p)
    squares = (by_pixel * p).sum(dim=1).clamp(min=0)
    # The last column is the constant 1, so its row of G p is the sum of the residuals.
    between = by_pixel[:, -1].square() / moments.gram[:, -1, -1].clamp(min=1e-300)
    weight = moments.gram[:, -1, -1]
    shares = {
        "all": _rms_mm(squares, weight),
        "between_images": _rms_mm(between, weight),
        "within_images": _rms_mm((squares - between).clamp(min=0), weight),
    }
    for target in np.unique(targets):
        chosen = torch.from_numpy(targets == target)
        shares[f"target_{target}"] = _rms_mm(squares[chosen], weight[chosen])
    return shares


def _rms_mm(squares: Tensor, weight: Tensor) -> float:
    return 1e3 * float((squares.sum() / weight.sum()).sqrt())


def _in_markdown(report: Mapping[str, Any]) -> Iterator[str]:
    """Yield the paragraphs of a report's text: why the solver stopped, errors, warnings."""
    yield f"**{report['model']}**: {report.get('message', report['stopped'])}"
    lines = ["| error [mm] | train mean abs. | train RMS | test mean abs. | test RMS |"]
    lines.append("| :-- | --: | --: | --: | --: |")
    for stage, halves in report["error_mm"].items():
        values = [halves[half][kind] for half in ("train", "test") for kind in ("mean_abs", "rms")]
        cells = ["–" if value is None else f"{value:.2f}" for value in values]
        lines.append(f"| {stage.replace('_', ' ')} | {' | '.join(cells)} |")
    yield "\n".join(lines)
    if report.get("warnings"):
        yield "\n".join(f"- {text}" for text in report["warnings"])
