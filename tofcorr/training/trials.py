"""Measures many sets of parameters on held-out frames, all in one pass over the pixels."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from tofcorr.data.frames import FrameBatch
from tofcorr.estimation.design import Design
from tofcorr.training.dataset import Dataset
from tofcorr.training.metrics import FrameErrors


@dataclass(frozen=True)
class Trial:
    """Parameters, and the frames that they are measured on.

    Attributes:
        tool_from_camera: Hand-eye transform, shape (4, 4).
        coefficients: Coefficients of the design's columns, shape (K,), metres.
        frames: Global numbers of the frames.
    """

    tool_from_camera: Tensor
    coefficients: Tensor
    frames: np.ndarray


@dataclass(frozen=True)
class TrialErrors:
    """What remains of the error under the parameters of a trial.

    Attributes:
        to_plane: Distance of the corrected points to the target's plane, which is what is fitted.
        along_ray: Corrected minus true distance along the viewing ray; larger at oblique rays.
        in_z: Corrected minus true depth along the optical axis, at the same ray.
    """

    to_plane: FrameErrors
    along_ray: FrameErrors
    in_z: FrameErrors


def measure(
    dataset: Dataset, design: Design, trials: Sequence[Trial], device: str = "cpu"
) -> list[TrialErrors]:
    """Measure every trial on its frames.

    The columns of a frame are computed once, whatever the number of trials: all residuals of a
    frame are one product of matrices.
    """
    table = _TrialTable(trials, device)
    pixel_functions = design.pixel_functions.flatten(1).to(device)
    rays = design.ray_directions.reshape(-1, 3).T.contiguous().to(device)
    wanted = np.unique(np.concatenate([trial.frames for trial in trials]))
    sums: list[list[tuple[int, Tensor]]] = [[] for _ in trials]
    for batch in dataset.batches(wanted, device):
        for k, frame in enumerate(batch.indices.tolist()):
            chosen = table.of_frame(frame)
            used = batch.valid[k].reshape(-1).nonzero()[:, 0]
            columns = _columns(batch, k, used, design, pixel_functions)
            normal, distance = table.plane_in_camera(chosen, batch, k)
            cosine = normal @ rays[:, used]
            residual = cosine * (table.factors[chosen] @ columns) + distance[:, None]
            for index, row in zip(
                chosen.tolist(), _sums(residual, cosine, rays[2, used]), strict=True
            ):
                sums[index].append((frame, row))
    return [_joined(parts) for parts in sums]


class _TrialTable:
    """All trials' parameters as tensors, and which of them concern a frame."""

    def __init__(self, trials: Sequence[Trial], device: str) -> None:
        ones = torch.ones(len(trials), 1, dtype=torch.float64)
        coefficients = torch.stack([trial.coefficients for trial in trials])
        self.factors = torch.cat([ones, -coefficients], dim=1).to(device)
        self._hand_eyes = torch.stack([trial.tool_from_camera for trial in trials]).to(device)
        self._frames = [set(trial.frames.tolist()) for trial in trials]

    def of_frame(self, frame: int) -> Tensor:
        """Return the indices of the trials that look at a frame."""
        return torch.tensor([k for k, frames in enumerate(self._frames) if frame in frames])

    def plane_in_camera(self, chosen: Tensor, batch: FrameBatch, k: int) -> tuple[Tensor, Tensor]:
        """Return the normals (S, 3) and offsets (S,) of the plane of batch entry k."""
        transform = self._hand_eyes[chosen]
        normal = batch.normal_tool[k] @ transform[:, :3, :3]
        return normal, transform[:, :3, 3] @ batch.normal_tool[k] + batch.offset_tool[k]


def _columns(
    batch: FrameBatch, k: int, used: Tensor, design: Design, pixel_functions: Tensor
) -> Tensor:
    """Return the distance and the error model's columns at some pixels, shape (C, M)."""
    distance = batch.radial_distance[k].reshape(-1)[used]
    amplitude = distance if batch.amplitude is None else batch.amplitude[k].reshape(-1)[used]
    signal = design.signal_functions(distance, amplitude)
    return signal[design.signal] * pixel_functions[:, used][design.pixel]


def _sums(residual: Tensor, cosine: Tensor, z_of_ray: Tensor) -> Tensor:
    """Return sums of |error| and error^2 of the three kinds, and the count, shape (S, 7)."""
    along_ray = residual / cosine
    sums = [
        part
        for error in (residual, along_ray, along_ray * z_of_ray)
        for part in (error.abs().sum(1), error.square().sum(1))
    ]
    count = torch.full_like(sums[0], residual.shape[1])
    return torch.stack([*sums, count], dim=1).cpu()


def _joined(parts: Sequence[tuple[int, Tensor]]) -> TrialErrors:
    frames = np.array([frame for frame, _ in parts], dtype=np.int64)
    rows = [row for _, row in parts]
    *sums, count = torch.stack(rows, dim=1).numpy() if rows else _NOTHING
    kinds = zip(sums[::2], sums[1::2], strict=True)
    return TrialErrors(*(FrameErrors(frames, total, square, count) for total, square in kinds))


_NOTHING = np.zeros((7, 0))
