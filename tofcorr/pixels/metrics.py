"""Errors of corrected points: their distance to the target's plane, frame by frame."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from tofcorr.correction.model import CalibrationModel
from tofcorr.geometry.rays import ray_directions
from tofcorr.pixels.dataset import Dataset
from tofcorr.pixels.distributed import everyones, own_share
from tofcorr.pixels.sample import distance_to_plane


@dataclass(frozen=True)
class FrameErrors:
    """Sums over the usable pixels of each frame.

    Attributes:
        frames: Global numbers, shape (N,).
        absolute: Sum of absolute distances to the plane, shape (N,), metres.
        squared: Sum of their squares, shape (N,), square metres.
        count: Pixels used, shape (N,).
    """

    frames: np.ndarray
    absolute: np.ndarray
    squared: np.ndarray
    count: np.ndarray

    def mean_abs_mm(self, frames: np.ndarray | None = None) -> float:
        """Return the mean absolute error over the pixels of some (or all) frames, millimetres."""
        inside = self._inside(frames)
        return 1e3 * _ratio(self.absolute[inside].sum(), self.count[inside].sum())

    def rms_mm(self, frames: np.ndarray | None = None) -> float:
        """Return the root mean square error over the pixels of some (or all) frames, mm."""
        inside = self._inside(frames)
        return 1e3 * math.sqrt(_ratio(self.squared[inside].sum(), self.count[inside].sum()))

    def _inside(self, frames: np.ndarray | None) -> np.ndarray:
        return np.isin(self.frames, self.frames if frames is None else frames)


def _ratio(total: float, count: float) -> float:
    return float(total / count) if count else math.nan


def frame_errors(
    dataset: Dataset,
    models: Mapping[str, CalibrationModel],
    frames: Sequence[int] | np.ndarray | None = None,
    device: str = "cpu",
) -> dict[str, FrameErrors]:
    """Measure models on frames, all in one pass over the pixels.

    Args:
        dataset: The recordings.
        models: What to measure, by name.
        frames: Global numbers; all frames if None.
        device: Where to compute.

    Returns:
        The sums of each model, frames in the order of the data set.
    """
    wanted = np.arange(dataset.num_frames) if frames is None else np.sort(np.asarray(frames))
    own = _own_sums(dataset, models, own_share(wanted), device)
    shares = everyones(own)
    order = np.concatenate([numbers for numbers, _ in shares])
    joined = {
        name: np.concatenate([sums[name] for _, sums in shares], axis=1)[:, np.argsort(order)]
        for name in models
    }
    return {name: FrameErrors(np.sort(order), *total) for name, total in joined.items()}


def _own_sums(
    dataset: Dataset, models: Mapping[str, CalibrationModel], frames: np.ndarray, device: str
) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """Return the frames that this process measures, and each model's three sums, (3, N)."""
    rays = ray_directions(dataset.first.camera).to(device)
    numbers: list[Tensor] = []
    sums: dict[str, list[Tensor]] = {name: [torch.zeros(3, 0)] for name in models}
    for batch in dataset.batches(frames, device):
        numbers.append(batch.indices.cpu())
        for name, model in models.items():
            residual = distance_to_plane(model, batch, rays)
            used = torch.where(batch.valid, residual, 0.0)
            per_frame = [used.abs().sum((1, 2)), used.square().sum((1, 2)), batch.valid.sum((1, 2))]
            sums[name].append(torch.stack([part.double() for part in per_frame]).cpu())
    order = torch.cat(numbers).numpy() if numbers else np.zeros(0, dtype=np.int64)
    return order, {name: torch.cat(parts, dim=1).numpy() for name, parts in sums.items()}
