"""Passes over the pixels of a data set: the moments of its images, and the errors of models.

Several processes, on one machine or many, share a pass: each of n takes every n-th frame. They
exchange sums over frames, whose size does not depend on that of the images. They are started by
`torchrun`; in a single process the functions here return their input.
"""

import math
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from copy import deepcopy
from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np
import torch
from torch import Tensor, distributed

from tofcorr.correction.model import CalibrationModel
from tofcorr.data.recording import FrameBatch
from tofcorr.error_terms.model import Pixels
from tofcorr.estimation.accumulator import Design, MomentAccumulator
from tofcorr.estimation.moments import ImageMoments, concatenate
from tofcorr.geometry.rays import plane_in_frame, plane_moves, plane_precision
from tofcorr.pixels.dataset import Dataset, Frames, in_threads, thread_number
from tofcorr.pixels.sample import pixels_of_image

ValueT = TypeVar("ValueT")


@contextmanager
def process_group(device: str) -> Iterator[str]:
    """Join the processes that `torchrun` started, for the length of the block.

    Args:
        device: `cpu` (gloo) or `cuda` (nccl).

    Yields:
        The device of this process: one GPU each, by its number on the machine.
    """
    if int(os.environ.get("WORLD_SIZE", "1")) == 1:
        yield device
        return
    on_gpu = device.startswith("cuda")
    if on_gpu:
        device = f"cuda:{os.environ['LOCAL_RANK']}"
        torch.cuda.set_device(device)
    distributed.init_process_group("nccl" if on_gpu else "gloo")
    try:
        yield device
    finally:
        distributed.destroy_process_group()


def is_first() -> bool:
    """Whether this process is the one that writes and prints."""
    return not distributed.is_initialized() or distributed.get_rank() == 0


def own_share(frames: Frames) -> np.ndarray:
    """Return the frames that this process reads."""
    frames = np.asarray(frames)
    if not distributed.is_initialized():
        return frames
    return frames[distributed.get_rank() :: distributed.get_world_size()]


def everyones(value: ValueT) -> list[ValueT]:
    """Return the values that all processes pass, in the order of their ranks."""
    if not distributed.is_initialized():
        return [value]
    values: list[ValueT | None] = [None] * distributed.get_world_size()
    distributed.all_gather_object(values, value)
    return values  # type: ignore[return-value]


Weighting = Callable[[FrameBatch], Tensor]
"""Gives the weights of a batch's pixels, shape (B, H, W), in 1/m^2 or without unit."""


def image_moments(
    dataset: Dataset,
    design: Design,
    frames: Frames | None = None,
    weighting: Weighting | None = None,
    device: str = "cpu",
) -> ImageMoments:
    """Return the moments of the frames, in their order, from one pass.

    Processes started by `torchrun` share the pass; each returns the moments of all frames.
    """
    wanted = np.arange(dataset.num_frames) if frames is None else np.asarray(frames)
    # The static images are looked at in small pieces, which threads would wait for.
    with thread_number(1):
        accumulator = MomentAccumulator(design, device)
    own = own_share(wanted)
    # Images stay as recorded where nothing but the sums reads them: half the bytes.
    as_recorded = weighting is None and dataset.exclude is None
    as_recorded &= dataset.first.depth_kind == "radial"
    dtype = torch.float32 if as_recorded else torch.float64
    images = dataset.batches(own, device, image_dtype=dtype)

    def moments_of(batch: FrameBatch) -> ImageMoments:
        return accumulator(batch, weighting(batch) if weighting else None)

    parts = in_threads(moments_of, images, None if device == "cpu" else 1)
    # Batches come recording by recording. A process may have no frame where there are more
    # processes than frames.
    read = [start + local for _, start, local in dataset.by_recording(own)]
    mine = [(np.concatenate(read), concatenate([*parts]))] if read else []
    everything = [part for share in everyones(mine) for part in share]
    numbers = np.concatenate([indices for indices, _ in everything])
    rank = np.argsort(np.argsort(wanted, kind="stable"), kind="stable")
    order = np.argsort(numbers, kind="stable")[rank].tolist()
    return concatenate([moments for _, moments in everything]).images(order)


KINDS = ("to_plane", "along_ray", "in_z", "within_views", "within_prior")
"""Kinds of error: the distance of the corrected points to the target's plane, which is what is
fitted; corrected minus true distance along the viewing ray, larger at oblique rays; corrected minus
true depth along the optical axis, at the same ray; what is left of that without the offset and the
two tilts of each image; and with each image's plane estimated again within its covariance."""


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


ErrorsByKind = Mapping[str, FrameErrors]
"""Of one model, by the names of `KINDS`."""


def views_mm(errors: ErrorsByKind, frames: np.ndarray | None = None) -> dict[str, float]:
    """Return RMS errors in z, mm: all, between views, within them, and with planes in their prior.

    The part between views is offset and tilts of whole images.
    """
    all_of_it, within, again = (errors[kind].rms_mm(frames) for kind in KINDS[2:])
    between = math.sqrt(np.maximum(all_of_it**2 - within**2, 0.0))
    found = {"rms_z": all_of_it, "between_views": between}
    return found | {"within_views": within, "within_prior": again}


@dataclass(frozen=True)
class FittedModel:
    """A model fitted to training frames, and what measures it.

    Attributes:
        model: Error model and hand-eye transform.
        held_out: Global numbers of the frames that measure it.
        planes: The data set whose planes it is judged against; None: that which measures it.
        variance: Effective variance of a residual, square metres, against which the covariance of
            the planes is weighed; 0: the planes as given.
    """

    model: CalibrationModel
    held_out: np.ndarray
    planes: Dataset | None = None
    variance: float = 0.0


def frame_errors(
    dataset: Dataset,
    models: Mapping[str, CalibrationModel],
    device: str = "cpu",
    variance: float = 0.0,
) -> dict[str, ErrorsByKind]:
    """Return the errors by kind that models leave on all frames; `variance`: of `FittedModel`."""
    every = np.arange(dataset.num_frames)
    fitted = [FittedModel(one, every, variance=variance) for one in models.values()]
    return dict(zip(models, held_out_errors(dataset, fitted, device), strict=True))


def held_out_errors(
    dataset: Dataset, fitted: Sequence[FittedModel], device: str = "cpu"
) -> list[dict[str, FrameErrors]]:
    """Measure every model on its held-out frames, all in one pass over the pixels.

    Processes started by `torchrun` share the pass.

    Args:
        dataset: The recordings, with the masks that choose the pixels to measure on.
        fitted: The models. All that hold out a frame are measured on the same pixels of it.
        device: Where to compute.

    Returns:
        The errors by kind, in the order of the models.
    """
    rays = dataset.ray_directions().reshape(-1, 3).to(device)
    # The caller's models stay where they are.
    models = [replace(one, model=deepcopy(one.model).to(device)) for one in fitted]
    planes = [_planes_in_tool(one.planes or dataset) for one in fitted]
    covariance = None if any(one.planes for one in fitted) else dataset.plane_covariance()
    frames = [set(one.held_out.tolist()) for one in fitted]
    sums: list[dict[int, Tensor]] = [{} for _ in fitted]
    wanted = np.unique(np.concatenate([one.held_out for one in fitted]))
    for batch in dataset.batches(own_share(wanted), device):
        for k, frame in enumerate(batch.indices.tolist()):
            used = batch.valid[k].reshape(-1).nonzero()[:, 0]
            pixels = pixels_of_image(batch, k, used)
            known = None if covariance is None else covariance[frame].to(device)
            for model, own, plane, found in zip(models, frames, planes, sums, strict=True):
                if frame in own:
                    there = plane[frame].to(device), known
                    found[frame] = _error_sums(model, pixels, rays[used], *there)
    shares = everyones(sums)
    return [
        _by_kind({k: v for own in one for k, v in own.items()}) for one in zip(*shares, strict=True)
    ]


def _planes_in_tool(dataset: Dataset) -> Tensor:
    """Return the planes n . x + d = 0 of a data set's frames in the tool frame, (N, 4)."""
    normal, offset = plane_in_frame(*dataset.planes_and_poses())
    return torch.cat([normal, offset[:, None]], dim=1)


@torch.no_grad()
def _error_sums(
    one: FittedModel, pixels: Pixels, rays: Tensor, plane: Tensor, covariance: Tensor | None
) -> Tensor:
    """Return |error| and error^2 of every kind, summed, and the number of pixels: (11,)."""
    model = one.model
    corrected = pixels.radial_distance - model.error.error_at(pixels)
    plane_in_camera = plane.to(corrected) @ model.hand_eye()
    cosine = rays @ plane_in_camera[:3]
    to_plane = cosine * corrected + plane_in_camera[3]
    # What turns and a shift of the plane do to the distances.
    normal, points = plane_in_camera[:3], rays * corrected[:, None]
    moves = torch.nn.functional.pad(points, (0, 1), value=1.0) @ plane_moves(normal).mT
    gram, slope = moves.mT @ moves, moves.mT @ to_plane
    within, again = to_plane - moves @ (torch.linalg.pinv(gram, hermitian=True) @ slope), to_plane
    if covariance is not None and one.variance:
        in_camera = model.hand_eye().mT @ covariance.to(corrected) @ model.hand_eye()
        precision = one.variance * plane_precision(normal, in_camera)
        again = to_plane - moves @ torch.linalg.solve(gram + precision, slope)
    along = rays[:, 2] / cosine
    kinds = [to_plane, to_plane / cosine, to_plane * along, within * along, again * along]
    kinds = torch.stack(kinds)
    sums = torch.stack([kinds.abs().sum(1), kinds.square().sum(1)], dim=1)
    return torch.cat([sums.flatten(), sums.new_tensor([len(rays)])]).cpu()


def _by_kind(sums: dict[int, Tensor]) -> dict[str, FrameErrors]:
    frames = np.array(sorted(sums), dtype=np.int64)
    rows = np.array([sums[k].numpy() for k in sorted(sums)]).reshape(-1, 2 * len(KINDS) + 1).T
    return {
        kind: FrameErrors(frames, rows[2 * k], rows[2 * k + 1], rows[-1])
        for k, kind in enumerate(KINDS)
    }
