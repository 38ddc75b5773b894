"""The errors of many fitted models on held-out frames, from one pass over the pixels."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from tofcorr.correction.model import CalibrationModel
from tofcorr.data.frames import planes_in_tool
from tofcorr.error_terms.model import Pixels
from tofcorr.pixels.dataset import Dataset
from tofcorr.pixels.image_pixels import error_at, pixels_of_image
from tofcorr.pixels.metrics import FrameErrors


class ToolPlanes(NamedTuple):
    """The plane of every frame of a data set, n . x + d = 0 in the tool frame.

    Attributes:
        normal: Unit normals, shape (N, 3).
        offset: d, shape (N,), metres.
    """

    normal: Tensor
    offset: Tensor


@dataclass(frozen=True)
class FittedModel:
    """A model fitted to training frames, and what measures it.

    Attributes:
        model: Error model and hand-eye transform.
        held_out: Global numbers of the frames that measure it.
        planes: The planes that it is judged against; None: those recorded.
    """

    model: CalibrationModel
    held_out: np.ndarray
    planes: ToolPlanes | None = None


@dataclass(frozen=True)
class HeldOutErrors:
    """What remains of a model's error on its held-out frames.

    Attributes:
        to_plane: Distance of the corrected points to the target's plane, which is what is fitted.
        along_ray: Corrected minus true distance along the viewing ray; larger at oblique rays.
        in_z: Corrected minus true depth along the optical axis, at the same ray.
    """

    to_plane: FrameErrors
    along_ray: FrameErrors
    in_z: FrameErrors


def planes_of(dataset: Dataset) -> ToolPlanes:
    """Return the planes of a data set's frames as its tables hold them."""
    planes = [planes_in_tool(recording) for recording in dataset.recordings]
    normals, offsets = zip(*planes, strict=True)
    return ToolPlanes(torch.cat(normals), torch.cat(offsets))


def held_out_errors(
    dataset: Dataset, fitted: Sequence[FittedModel], device: str = "cpu"
) -> list[HeldOutErrors]:
    """Measure every model on its held-out frames.

    Args:
        dataset: The recordings, with the masks that choose the pixels to measure on.
        fitted: The models. All that hold out a frame are measured on the same pixels of it.
        device: Where to compute.

    Returns:
        The errors, in the order of the models.
    """
    rays = dataset.ray_directions().reshape(-1, 3).to(device)
    recorded = planes_of(dataset)
    models = [one.model.to(device) for one in fitted]
    planes = [one.planes or recorded for one in fitted]
    frames = [set(one.held_out.tolist()) for one in fitted]
    sums: list[list[tuple[int, Tensor]]] = [[] for _ in fitted]
    for batch in dataset.batches(np.unique(np.concatenate([f.held_out for f in fitted])), device):
        for k, frame in enumerate(batch.indices.tolist()):
            used = batch.valid[k].reshape(-1).nonzero()[:, 0]
            pixels = pixels_of_image(batch, k, used)
            for model, own, plane, found in zip(models, frames, planes, sums, strict=True):
                if frame in own:
                    normal, offset = (part[frame].to(pixels.radial_distance) for part in plane)
                    found.append((frame, _error_sums(model, pixels, rays[used], normal, offset)))
    return [_joined(found) for found in sums]


@torch.no_grad()
def _error_sums(
    model: CalibrationModel, pixels: Pixels, rays: Tensor, normal_tool: Tensor, offset_tool: Tensor
) -> Tensor:
    """Return sums of |error| and error^2 of the three kinds, and the count, shape (7,)."""
    corrected = pixels.radial_distance - error_at(model.error, pixels)
    tool_from_camera = model.hand_eye()
    cosine = rays @ (normal_tool @ tool_from_camera[:3, :3])
    to_plane = cosine * corrected + normal_tool @ tool_from_camera[:3, 3] + offset_tool
    along_ray = to_plane / cosine
    sums = [
        total
        for kind in (to_plane, along_ray, along_ray * rays[:, 2])
        for total in (kind.abs().sum(), kind.square().sum())
    ]
    return torch.stack([*sums, to_plane.new_tensor(float(len(rays)))]).cpu()


def _joined(found: Sequence[tuple[int, Tensor]]) -> HeldOutErrors:
    frames = np.array([frame for frame, _ in found], dtype=np.int64)
    rows = [row for _, row in found]
    *sums, count = torch.stack(rows, dim=1).numpy() if rows else np.zeros((7, 0))
    kinds = zip(sums[::2], sums[1::2], strict=True)
    return HeldOutErrors(*(FrameErrors(frames, total, square, count) for total, square in kinds))
