"""Measures many fitted models on held-out frames, all in one pass over the pixels."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from tofcorr.correction.model import CalibrationModel
from tofcorr.data.frames import FrameBatch
from tofcorr.error_terms.model import Pixels
from tofcorr.pixels.dataset import Dataset
from tofcorr.pixels.metrics import FrameErrors


@dataclass(frozen=True)
class Trial:
    """A fitted model, and the frames that it is measured on.

    Attributes:
        model: Error model and hand-eye transform.
        frames: Global numbers of the frames.
    """

    model: CalibrationModel
    frames: np.ndarray


@dataclass(frozen=True)
class TrialErrors:
    """What remains of the error under the model of a trial.

    Attributes:
        to_plane: Distance of the corrected points to the target's plane, which is what is fitted.
        along_ray: Corrected minus true distance along the viewing ray; larger at oblique rays.
        in_z: Corrected minus true depth along the optical axis, at the same ray.
    """

    to_plane: FrameErrors
    along_ray: FrameErrors
    in_z: FrameErrors


def measure(dataset: Dataset, trials: Sequence[Trial], device: str = "cpu") -> list[TrialErrors]:
    """Measure every trial on its frames; the usable pixels of a frame are gathered but once."""
    rays = dataset.ray_directions().reshape(-1, 3).to(device)
    models = [trial.model.to(device) for trial in trials]
    concerned = [set(trial.frames.tolist()) for trial in trials]
    sums: list[list[tuple[int, Tensor]]] = [[] for _ in trials]
    for batch in dataset.batches(np.unique(np.concatenate([t.frames for t in trials])), device):
        for k, frame in enumerate(batch.indices.tolist()):
            pixels, used = _usable(batch, k)
            for model, frames, parts in zip(models, concerned, sums, strict=True):
                if frame in frames:
                    parts.append((frame, _errors(model, pixels, rays[used], batch, k)))
    return [_joined(parts) for parts in sums]


def _usable(batch: FrameBatch, k: int) -> tuple[Pixels, Tensor]:
    """Return the usable pixels of batch entry k, and their numbers in the image, shape (M,)."""
    width = batch.valid.shape[2]
    used = batch.valid[k].reshape(-1).nonzero()[:, 0]
    distance = batch.radial_distance[k].reshape(-1)[used]
    amplitude = distance if batch.amplitude is None else batch.amplitude[k].reshape(-1)[used]
    assert batch.conditions is not None
    conditions = batch.conditions[k].expand(len(used), -1)
    rows, columns = (used // width).to(distance), (used % width).to(distance)
    return Pixels(distance, amplitude, rows, columns, conditions), used


@torch.no_grad()
def _errors(
    model: CalibrationModel, pixels: Pixels, rays: Tensor, batch: FrameBatch, k: int
) -> Tensor:
    """Return sums of |error| and error^2 of the three kinds, and the count, shape (7,)."""
    error = model.error
    predicted = error.coefficient_vector() @ error.columns_at(pixels)
    corrected = pixels.radial_distance - predicted
    corrected = corrected - error.pattern_at(pixels) - error.residual_at(pixels)
    tool_from_camera = model.hand_eye()
    normal, offset = batch.normal_tool[k], batch.offset_tool[k]
    cosine = rays @ (normal @ tool_from_camera[:3, :3])
    to_plane = cosine * corrected + normal @ tool_from_camera[:3, 3] + offset
    along_ray = to_plane / cosine
    sums = [
        part
        for kind in (to_plane, along_ray, along_ray * rays[:, 2])
        for part in (kind.abs().sum(), kind.square().sum())
    ]
    return torch.stack([*sums, to_plane.new_tensor(float(len(rays)))]).cpu()


def _joined(parts: Sequence[tuple[int, Tensor]]) -> TrialErrors:
    frames = np.array([frame for frame, _ in parts], dtype=np.int64)
    rows = [row for _, row in parts]
    *sums, count = torch.stack(rows, dim=1).numpy() if rows else _NOTHING
    kinds = zip(sums[::2], sums[1::2], strict=True)
    return TrialErrors(*(FrameErrors(frames, total, square, count) for total, square in kinds))


_NOTHING = np.zeros((7, 0))
