"""Writes the course of a calibration for TensorBoard, with curves and error images."""

import math
import threading
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor

from tofcorr.estimation.moments import ImageMoments
from tofcorr.estimation.objective import Parameters, residual_vectors
from tofcorr.estimation.solvers import Iteration
from tofcorr.geometry import se3
from tofcorr.pixels.sample import PixelSample, sample_pixels
from tofcorr.training.calibration import Calibration
from tofcorr.training.shown import ends_of, error_images, error_picture, frames_to_show, profile

if TYPE_CHECKING:
    from torch.utils.tensorboard import SummaryWriter

# TensorBoard counts steps in whole numbers, so a covariate is multiplied by a power of ten until
# its range has at least so many steps. Chosen: bins stay apart.
_LEAST_STEPS = 300


def pixels_shown(calibration: Calibration) -> PixelSample:
    """Return the sample of pixels that curves and distributions come from."""
    frames = np.sort(np.concatenate([calibration.train, calibration.test]))
    return sample_pixels(calibration.data, calibration.stages, frames)


def curves(calibration: Calibration, sample: PixelSample) -> Iterator[tuple[str, int, float]]:
    """Yield tag, step and value of the mean error over each covariate, mm.

    The step is the covariate, multiplied by the power of ten that the tag names.
    """
    tested = np.isin(sample.frame, calibration.test)
    for covariate, x in sample.covariates.items():
        low, high = ends = ends_of(x)
        power = max(math.ceil(math.log10(_LEAST_STEPS / max(high - low, 1e-9))), 0)
        name = covariate.split(" [")[0].replace(" ", "_")
        name += f"_x{10**power}" if power else ""
        shown = {stage: (x, error) for stage, error in sample.errors_mm.items()}
        if tested.any() and "after" in shown:
            shown["after_held_out"] = x[tested], sample.errors_mm["after"][tested]
        for stage, (at, error) in shown.items():
            found = profile(at, error, ends)
            steps = np.round(found.middle * 10**power).astype(int).tolist()
            for step, mean in zip(steps, found.mean.tolist(), strict=True):
                yield f"error_mm_against/{name}/{stage}", step, mean


def distributions(
    calibration: Calibration, sample: PixelSample
) -> Iterator[tuple[str, np.ndarray]]:
    """Yield tag and values of the errors at each stage, mm, of fitted and of held-out frames."""
    tested = np.isin(sample.frame, calibration.test)
    for stage, errors in sample.errors_mm.items():
        for half, chosen in (("fitted", ~tested), ("held_out", tested)):
            known = errors[chosen & np.isfinite(errors)]
            if len(known):
                yield f"error_mm/{stage}_{half}", known


def drawn(calibration: Calibration) -> tuple[np.ndarray, str]:
    """Return the error images of some frames, (H, W, 3), uint8, and what they show."""
    return error_picture(*error_images(calibration, frames_to_show(calibration)))


class RunMonitor:
    """Remembers the course of a run, and writes it for TensorBoard once the run is on disk.

    `iteration` is a `Watcher`: pass it to `calibrate`.

    Attributes:
        iterations: Every iteration of the solver so far.

    Example:
        monitor = RunMonitor()
        calibration = calibrate(data, options, watcher=monitor.iteration)
        monitor.write(run / "tb", calibration, report)
    """

    def __init__(self) -> None:
        self.iterations: list[Iteration] = []
        self._times: list[float] = []

    def iteration(self, iteration: Iteration) -> None:
        """Record one iteration of the solver; never interrupts it."""
        self.iterations.append(iteration)
        self._times.append(time.time())

    def write(
        self,
        folder: Path | str,
        calibration: Calibration,
        report: Mapping[str, Any] | None = None,
        *,
        figures: bool = True,
    ) -> None:
        """Write TensorBoard's files.

        Args:
            folder: Where the event files go, usually RUN/tb; made if it is missing.
            calibration: The fitted model and its errors.
            report: The content of report.json, to be shown as text.
            figures: Whether to draw figures, which take longer than the rest.
        """
        with event_writer(folder) as writer:
            for values in self._scalars(calibration):
                writer.add_scalar(*values)
            if report:
                writer.add_text("report", "\n\n".join(_in_markdown(report)))
            if figures:
                _write_figures(writer, calibration)

    def _scalars(self, calibration: Calibration) -> Iterator[tuple[str, float, int, float]]:
        """Yield tag, value, iteration and time of every number.

        One step further than the last iteration stands the estimate, which the noise's shift was
        taken off.
        """
        if not self.iterations:
            return
        moments, targets = calibration.fit.moments, calibration.data.targets[calibration.train]
        start, last = self.iterations[0].parameters, self.iterations[-1].number

        def state(parameters: Parameters) -> dict[str, float]:
            parts = loss_parts(moments, parameters, targets)
            return {
                **_moved(start, parameters),
                **_coefficients(moments, parameters),
                **{f"rms_mm/{name}": value for name, value in parts.items()},
            }

        for iteration, when in zip(self.iterations, self._times, strict=True):
            for tag, value in (_convergence(iteration) | state(iteration.parameters)).items():
                yield tag, value, iteration.number, when
        for tag, value in state(calibration.fit.solution.parameters).items():
            yield tag, value, last + 1, self._times[-1]


@contextmanager
def event_writer(folder: Path | str) -> Iterator["SummaryWriter"]:
    """Yield a writer of TensorBoard's files, whose thread prints no traceback when it fails.

    Args:
        folder: Where the event files go; made if it is missing.

    Raises:
        OSError: They could not be written, for example because the disk is full.
    """
    from torch.utils.tensorboard import SummaryWriter

    ended: list[BaseException | None] = []
    before = threading.excepthook
    threading.excepthook = keep = lambda arguments: ended.append(arguments.exc_value)
    try:
        with SummaryWriter(str(folder)) as writer:
            yield writer
    finally:
        if threading.excepthook is keep:
            threading.excepthook = before
    for error in ended:
        if error is not None:
            raise error


def _write_figures(writer: "SummaryWriter", calibration: Calibration) -> None:

    sample = pixels_shown(calibration)
    for tag, step, value in curves(calibration, sample):
        writer.add_scalar(tag, value, step)
    for tag, values in distributions(calibration, sample):
        writer.add_histogram(tag, values)
    image, words = drawn(calibration)
    writer.add_image("frames/error_before_and_after", image, dataformats="HWC")
    writer.add_text("frames/error_before_and_after", words)


def _convergence(iteration: Iteration) -> dict[str, float]:
    step_left = math.log10(max(iteration.step_left, 1e-300))
    return {
        "convergence/loss_m2": iteration.loss,
        "convergence/log10_step_left_se": step_left,
    }


def _moved(start: Parameters, now: Parameters) -> dict[str, float]:
    """Return how far the hand-eye transform is from where it started."""
    before, after = start.tool_from_camera, now.tool_from_camera
    turned = torch.rad2deg(se3.rotation_angle(before[:3, :3].T @ after[:3, :3]))
    shift = 1e3 * (after - before)[:3, 3]
    return {
        **{f"hand_eye_since_start/t_{a}_mm": float(s) for a, s in zip("xyz", shift, strict=True)},
        "hand_eye_since_start/rotation_deg": float(turned),
    }


def _coefficients(moments: ImageMoments, parameters: Parameters) -> dict[str, float]:
    values = parameters.coefficients.tolist()
    # TensorBoard allows no ^ in a tag; c^1 of the column must not become c1.
    tags = [symbol.replace("^", "_to_the_") for symbol in moments.symbols]
    return {f"coefficients_mm/{tag}": 1e3 * v for tag, v in zip(tags, values, strict=True)}


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
