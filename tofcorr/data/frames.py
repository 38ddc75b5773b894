"""Frames in batches of bounded size, in the form that fitting needs."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from tofcorr.conditions import CONDITIONS
from tofcorr.data.recording import Recording
from tofcorr.data.table import FrameTable
from tofcorr.geometry.planes import plane_in_frame
from tofcorr.geometry.ranges import radial_distance_from_z_depth
from tofcorr.geometry.rays import ray_directions


@dataclass(frozen=True, kw_only=True, eq=False)
class FrameBatch:
    """Some frames of a recording.

    Attributes:
        indices: Which frames, shape (B,), int64.
        radial_distance: Measured distance along the ray whatever the recording's `depth_kind`,
            shape (B, H, W), metres; undefined where not `valid`.
        amplitude: Counts, shape (B, H, W); None if not recorded.
        valid: Where a pixel may be used, shape (B, H, W), bool.
        normal_tool: Unit normal of the target's plane in the tool frame, shape (B, 3).
        offset_tool: Its offset d in n . x + d = 0, shape (B,), metres.
        conditions: Conditions in the order of `CONDITIONS`, shape (B, C), NaN where unknown; None
            if the batch was built without them.
    """

    indices: Tensor
    radial_distance: Tensor
    amplitude: Tensor | None
    valid: Tensor
    normal_tool: Tensor
    offset_tool: Tensor
    conditions: Tensor | None = None


def iterate_frames(
    recording: Recording,
    indices: Sequence[int] | np.ndarray | None = None,
    chunk_pixels: int = 2_000_000,
    dtype: torch.dtype = torch.float64,
    device: torch.device | str = "cpu",
    image_dtype: torch.dtype | None = None,
) -> Iterator[FrameBatch]:
    """Yield frames in batches of bounded size, read from disk as they are needed.

    Args:
        recording: The recording.
        indices: Which frames, in this order, repeats allowed; None: all.
        chunk_pixels: Largest number of pixels per batch, but at least one frame.
        dtype: Of the floating point tensors.
        device: Of all tensors.
        image_dtype: Of distance and amplitude; None: `dtype`. Radial distances and amplitudes are
            recorded in float32, which holds them without loss.

    Yields:
        Batches that together contain every chosen frame, in order.

    Raises:
        CalibrationDataError: A frame holds a value that the format does not allow.
        IndexError: There is no such frame.
    """
    chosen = _checked_indices(indices, recording.num_frames)
    camera = recording.camera
    normals, offsets = planes_in_tool(recording)
    conditions = frame_conditions(recording.frames)
    image_dtype = image_dtype or dtype
    rays = None
    if recording.depth_kind == "z":
        rays = ray_directions(camera).to(device=device, dtype=image_dtype)
    step = max(1, chunk_pixels // (camera.height * camera.width))
    for start in range(0, len(chosen), step):
        chunk = chosen[start : start + step]
        depth = recording.read("depth", chunk)
        assert depth is not None
        distance = torch.from_numpy(depth).to(device, image_dtype)
        if rays is not None:
            distance = radial_distance_from_z_depth(distance, rays)
        amplitude = _read(recording, "amplitude", chunk)
        if amplitude is not None:
            amplitude = amplitude.to(device, image_dtype)
        mask = _read(recording, "mask", chunk)
        yield FrameBatch(
            indices=torch.from_numpy(chunk).to(device),
            radial_distance=distance,
            amplitude=amplitude,
            valid=valid_pixels(
                distance,
                amplitude,
                None if mask is None else mask.to(device),
                recording.saturation_amplitude,
            ),
            normal_tool=normals[chunk].to(device, dtype),
            offset_tool=offsets[chunk].to(device, dtype),
            conditions=conditions[chunk].to(device, dtype),
        )


def valid_pixels(
    distance: Tensor,
    amplitude: Tensor | None = None,
    mask: Tensor | None = None,
    saturation_amplitude: float | None = None,
) -> Tensor:
    """Return True where a pixel holds a usable measurement of the target.

    A pixel is usable if its distance is finite and positive (NaN or <= 0 means "no return"), it
    sees the target, and its amplitude, if recorded, is finite and below saturation.

    Args:
        distance: Measured distances of either kind, shape (..., H, W), metres.
        amplitude: Amplitudes, shape of `distance`; None if unknown.
        mask: Non-zero where the pixel sees the target, shape of `distance`; None: everywhere.
        saturation_amplitude: Pixels at or above it are not used; None if unknown.

    Returns:
        Shape of `distance`, bool.
    """
    # Zero times NaN or infinity is NaN, above which nothing lies. Comparisons are not vectorised:
    # they take three times as long as the arithmetic.
    zero = distance * 0.0
    if amplitude is not None:
        zero.add_(amplitude, alpha=0.0)
    valid = distance > zero
    if amplitude is not None and saturation_amplitude is not None:
        valid &= amplitude < saturation_amplitude
    if mask is not None:
        valid &= mask.bool()
    return valid


def frame_conditions(table: FrameTable) -> Tensor:
    """Return the conditions of every frame (N, C) in the order of `CONDITIONS`; NaN: unknown."""
    columns = [getattr(table, name) for name in CONDITIONS]
    unknown = np.full(len(table), np.nan)
    known = [unknown if column is None else column for column in columns]
    return torch.from_numpy(np.stack(known, axis=1).astype(np.float64))


def planes_in_tool(recording: Recording) -> tuple[Tensor, Tensor]:
    """Return the target's plane in the tool frame: normals (N, 3), offsets (N,), float64."""
    table = recording.frames
    return plane_in_frame(
        torch.from_numpy(table.normal_world),
        torch.from_numpy(table.offset),
        torch.from_numpy(table.world_from_tool),
    )


def _checked_indices(indices: Sequence[int] | np.ndarray | None, num_frames: int) -> np.ndarray:
    if indices is None:
        return np.arange(num_frames)
    chosen = np.asarray(indices, dtype=np.int64).reshape(-1)
    for wrong in chosen[(chosen < 0) | (chosen >= num_frames)][:1]:
        raise IndexError(f"there is no frame {wrong}: the recording has {num_frames}.")
    return chosen


def _read(recording: Recording, name: str, chunk: np.ndarray) -> Tensor | None:
    frames = recording.read(name, chunk)
    return None if frames is None else torch.from_numpy(frames)
