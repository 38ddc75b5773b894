"""Errors of corrected points: their distance to the target's plane, frame by frame."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import torch

from tofcorr.correction.model import CalibrationModel
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
        return 1e3 * self._mean(self.absolute, frames)

    def rms_mm(self, frames: np.ndarray | None = None) -> float:
        """Return the root mean square error over the pixels of some (or all) frames, mm."""
        return 1e3 * math.sqrt(self._mean(self.squared, frames))

    def _mean(self, sums: np.ndarray, frames: np.ndarray | None) -> float:
        inside = np.isin(self.frames, self.frames if frames is None else frames)
        count = self.count[inside].sum()
        return float(sums[inside].sum() / count) if count else math.nan


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
    rays = dataset.ray_directions().to(device)
    numbers = [np.zeros(0, dtype=np.int64)]
    sums = {name: [np.zeros((3, 0))] for name in models}
    for batch in dataset.batches(own_share(wanted), device):
        numbers.append(batch.indices.cpu().numpy())
        for name, model in models.items():
            used = torch.where(batch.valid, distance_to_plane(model, batch, rays), 0.0)
            per_frame = [used.abs().sum((1, 2)), used.square().sum((1, 2)), batch.valid.sum((1, 2))]
            sums[name].append(torch.stack([part.double() for part in per_frame]).cpu().numpy())
    shares = everyones((numbers, sums))
    frame = np.concatenate([part for own, _ in shares for part in own])
    order, found = np.argsort(frame), {}
    for name in models:
        total = np.concatenate([part for _, own in shares for part in own[name]], axis=1)
        found[name] = FrameErrors(frame[order], *total[:, order])
    return found
