"""Watches a calibration in TensorBoard."""

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

from tofcorr.correction.model import CalibrationModel
from tofcorr.data.frames import FrameBatch
from tofcorr.estimation.moments import ImageMoments
from tofcorr.estimation.objective import residual_vectors
from tofcorr.estimation.parameters import Parameters
from tofcorr.estimation.solution import Iteration
from tofcorr.fit.fitting import Fit
from tofcorr.geometry import se3
from tofcorr.geometry.planes import tangents
from tofcorr.pixels.dataset import Dataset
from tofcorr.pixels.metrics import frame_errors
from tofcorr.pixels.pixel_sample import errors_along_ray, sample_pixels, thinned
from tofcorr.training.figures import pixels_of, points_figure, profile_figure, residual_figure

_FRAMES_SHOWN = 5
# Pixels whose error is measured to choose the frames shown, and points drawn of one frame.
_PIXELS_RANKED = 3_000_000
_POINTS_SHOWN = 4000


class RunMonitor:
    """Writes what happens in a run for TensorBoard.

    `iteration` is a `Watcher`: pass it to `fit`. `finish` is called once, after the fit.

    Args:
        folder: Where the event files go, usually RUN/tb; made if it is missing.

    Example:
        with RunMonitor(run / "tb") as monitor:
            fitted = fit(dataset, train, options, domain, watcher=monitor.iteration)
            monitor.finish(dataset, fitted, stages, train, test, report)
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

    def finish(
        self,
        dataset: Dataset,
        fit: Fit,
        stages: Mapping[str, CalibrationModel],
        train: np.ndarray,
        test: np.ndarray,
        report: Mapping[str, Any] | None = None,
    ) -> None:
        """Record what can only be shown after the fit.

        Args:
            dataset: The recordings.
            fit: The fitted model.
            stages: `before`, `hand_eye_only` and `after`, in this order.
            train: Global numbers of the frames fitted.
            test: Global numbers of the frames held out; may be empty.
            report: The content of report.json, to be shown as text.
        """
        self._loss_parts(fit.moments, dataset.targets[train])
        self._coefficients(fit)
        frames = np.sort(np.concatenate([train, test]))
        sample = sample_pixels(dataset, stages, frames)
        for covariate in sample.covariates:
            name = covariate.split(" [")[0].replace(" ", "_")
            self._figure(f"error_against/{name}", profile_figure(sample, covariate, test))
        chosen = _frames_to_show(dataset, stages["after"], frames)
        self._residual_images(dataset, stages, chosen, test)
        self._points(dataset, stages, int(chosen[len(chosen) // 2]))
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
            parts = loss_parts(moments, iteration.parameters, targets)
            for name, value in parts.items():
                self._writer.add_scalar(f"rms_mm/{name}", value, iteration.number)

    def _coefficients(self, fit: Fit) -> None:
        for iteration in self._iterations:
            values = iteration.parameters.coefficients.tolist()
            for symbol, value in zip(fit.moments.symbols, values, strict=True):
                # TensorBoard allows no ^ in a tag; c^1 of the column must not become c1.
                tag = symbol.replace("^", "_to_the_")
                self._writer.add_scalar(f"coefficients_mm/{tag}", 1e3 * value, iteration.number)

    def _residual_images(
        self,
        dataset: Dataset,
        stages: Mapping[str, CalibrationModel],
        chosen: np.ndarray,
        test: np.ndarray,
    ) -> None:
        images, titles = [], []
        for batch in _one_by_one(dataset, chosen):
            frame = int(batch.indices[0])
            images.append(
                {
                    stage: errors_along_ray(dataset, stages[stage], batch)[0][0].numpy()
                    for stage in ("before", "after")
                }
            )
            part = "held out" if frame in test else "fitted"
            titles.append(f"frame {frame}, {dataset.targets[frame]}\n{part}")
        self._figure("frames/error_before_and_after", residual_figure(images, titles))

    def _points(self, dataset: Dataset, stages: Mapping[str, CalibrationModel], frame: int) -> None:
        batch = next(_one_by_one(dataset, np.array([frame])))
        clouds = {name: _points_on_plane(dataset, model, batch) for name, model in stages.items()}
        title = f"Frame {frame}, {dataset.targets[frame]}: points and plane, height stretched"
        self._figure("frames/points_before_and_after", points_figure(clouds, title))

    def _figure(self, tag: str, figure: Figure) -> None:
        self._writer.add_image(tag, pixels_of(figure), dataformats="HWC")


def loss_parts(
    moments: ImageMoments, parameters: Parameters, targets: np.ndarray
) -> dict[str, float]:
    """Split the loss by target and into its parts between and within images.

    The part between images is that of the images' mean residuals: what poses, hand-eye and planes
    have to answer for. The part within is left when each image's mean is taken away. The squares
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
    parts = {
        "all": _rms_mm(squares, weight),
        "between_images": _rms_mm(between, weight),
        "within_images": _rms_mm((squares - between).clamp(min=0), weight),
    }
    for target in np.unique(targets):
        chosen = torch.from_numpy(targets == target)
        parts[f"target_{target}"] = _rms_mm(squares[chosen], weight[chosen])
    return parts


def _rms_mm(squares: Tensor, weight: Tensor) -> float:
    return 1e3 * float((squares.sum() / weight.sum()).sqrt())


def _frames_to_show(dataset: Dataset, model: CalibrationModel, frames: np.ndarray) -> np.ndarray:
    """Return frames from the best corrected to the worst, at regular ranks."""
    camera = dataset.first.camera
    most = max(_PIXELS_RANKED // (camera.height * camera.width), _FRAMES_SHOWN)
    ranked = thinned(frames, most)
    errors = frame_errors(dataset, {"after": model}, ranked)["after"]
    used = errors.count > 0
    order = np.argsort(errors.squared[used] / errors.count[used])
    return thinned(errors.frames[used][order], _FRAMES_SHOWN)


def _one_by_one(dataset: Dataset, frames: np.ndarray) -> Iterator[FrameBatch]:
    """Yield batches of one frame each, in the order given."""
    for frame in frames:
        yield from dataset.batches(np.array([frame]))


def _points_on_plane(dataset: Dataset, model: CalibrationModel, batch: FrameBatch) -> np.ndarray:
    """Return coordinates within the plane (m) and the distance to it (mm), shape (M, 3)."""
    error, cosine = errors_along_ray(dataset, model, batch)
    used = batch.valid[0].reshape(-1).nonzero()[:, 0]
    used = used[torch.from_numpy(thinned(np.arange(len(used)), _POINTS_SHOWN))]
    distance_mm = (error * cosine)[0].reshape(-1)[used]
    transform = model.hand_eye().detach()
    rays = dataset.ray_directions().reshape(-1, 3)[used] @ transform[:3, :3].T
    along = batch.radial_distance[0].reshape(-1)[used]
    normal = batch.normal_tool[0]
    points = rays * along[:, None]
    return torch.cat([points @ tangents(normal).T, distance_mm[:, None]], dim=1).numpy()


def _in_markdown(report: Mapping[str, Any]) -> Iterator[str]:
    """Yield the parts of a report's text: how it ended, its errors, its warnings."""
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
