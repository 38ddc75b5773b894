"""A recording with its depth corrected: as a recording, and as point clouds before and after."""

from collections.abc import Callable, Iterator, Mapping
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from tofcorr.data.arrays import read_frames
from tofcorr.data.recording import Recording
from tofcorr.data.writing import RecordingWriter
from tofcorr.files.staged import StagedFolder
from tofcorr.geometry.rays import ray_directions

Corrector = Callable[[Tensor, Tensor], tuple[Tensor, Tensor]]
"""Takes depth and amplitude, shape (B, H, W), float32, and returns corrected depth and where it is
valid. Amplitudes are NaN where a recording has none."""

_PLY_TYPES = {"float32": "float", "uint8": "uchar"}
_AXES = "camera frame, metres: x right, y down, z forward (optical frame of REP 103)"


def write_corrected(
    corrector: Corrector,
    recording: Recording,
    path: Path | str,
    *,
    chunk_pixels: int = 2_000_000,
    progress: Callable[[int], object] = lambda frames: None,
) -> float:
    """Write a copy of `recording` with corrected depth, in memory bounded by `chunk_pixels`.

    Rows, header and amplitude are copied. The mask is 1 where that of `recording` is 1 and the
    correction is valid. Raw samples are left out: they would contradict the depth.

    Args:
        corrector: What corrects.
        recording: The recording to correct.
        path: The folder to write; it must not exist yet.
        chunk_pixels: Pixels corrected at once, but at least one frame.
        progress: Called with the number of frames written since the last call.

    Returns:
        The share of the pixels on the target with a return that are in the calibrated range.

    Raises:
        CalibrationDataError: `path` exists, cannot be written, or `recording` is broken.
    """
    camera = recording.camera
    step = max(1, chunk_pixels // (camera.height * camera.width))
    num_returns = num_valid = 0
    with RecordingWriter.like(path, recording) as writer, torch.inference_mode():
        for depth, amplitude, on_target, corrected, kept in _frames(corrector, recording, step):
            for i, frame in enumerate(corrected):
                strength = None if amplitude is None else amplitude[i]
                writer.append(frame, amplitude=strength, mask=kept[i])
            num_returns += int((_returned(depth) & on_target).sum())
            num_valid += int(kept.sum())
            progress(len(depth))
    return num_valid / max(1, num_returns)


def write_point_clouds(
    corrector: Corrector,
    recording: Recording,
    path: Path | str,
    *,
    progress: Callable[[int], object] = lambda frames: None,
) -> None:
    """Write `frame_000_before.ply` and `frame_000_after.ply` for each frame of a recording.

    A pixel without a return is not a point. Points have `amplitude` where it was recorded; after
    correction, `valid` is 1 inside the calibrated range and on the target.

    Args:
        corrector: What corrects.
        recording: What to correct.
        path: The folder, which must not exist yet.
        progress: Called with the number of frames that were just written.

    Raises:
        CalibrationDataError: `path` exists, the disk refuses, or `recording` is broken.
    """
    rays = ray_directions(recording.camera)
    directions = (rays / rays[..., 2:] if recording.depth_kind == "z" else rays).numpy()
    digits = max(3, len(str(recording.num_frames - 1)))
    with StagedFolder(path) as stage, torch.inference_mode():
        frames = _frames(corrector, recording, 1)
        for number, (depth, amplitude, _, corrected, kept) in enumerate(frames):
            name = stage.folder / f"frame_{number:0{digits}d}"
            more = {} if amplitude is None else {"amplitude": amplitude[0]}
            _write_points(Path(f"{name}_before.ply"), depth[0], directions, more)
            more["valid"] = kept[0].astype(np.uint8)
            _write_points(Path(f"{name}_after.ply"), corrected[0], directions, more)
            progress(1)


def _frames(
    corrector: Corrector, recording: Recording, at_once: int
) -> Iterator[tuple[np.ndarray, np.ndarray | None, np.ndarray, np.ndarray, np.ndarray]]:
    """Yield the frames of a recording in order, so many at once.

    Yields:
        Depth as recorded; amplitude as recorded, or None; where a pixel looks at the target;
        corrected depth; where the correction is valid on the target: each of shape (B, H, W).
    """
    for start in range(0, recording.num_frames, at_once):
        chunk = np.arange(start, min(start + at_once, recording.num_frames))
        depth = read_frames(recording.depth, chunk)
        amplitude = recording.read("amplitude", chunk)
        mask = recording.read("mask", chunk)
        on_target = np.ones(depth.shape, dtype=bool) if mask is None else mask == 1
        given = np.full_like(depth, np.nan) if amplitude is None else amplitude
        corrected, valid = corrector(torch.from_numpy(depth), torch.from_numpy(given))
        yield depth, amplitude, on_target, corrected.numpy(), on_target & valid.numpy()


def _returned(depth: np.ndarray) -> np.ndarray:
    return np.isfinite(depth) & (depth > 0)


def _write_points(
    path: Path, depth: np.ndarray, directions: np.ndarray, more: Mapping[str, np.ndarray]
) -> None:
    """Write the points of an image (H, W) with further properties (H, W), as binary PLY."""
    seen = _returned(depth)
    points = (directions[seen] * depth[seen][:, None].astype(np.float64)).astype(np.float32)
    columns = {axis: points[:, k] for k, axis in enumerate("xyz")}
    columns |= {name: image[seen] for name, image in more.items()}
    table = np.rec.fromarrays(
        list(columns.values()),
        dtype=[(name, values.dtype.newbyteorder("<")) for name, values in columns.items()],
    )
    header = [
        "ply",
        "format binary_little_endian 1.0",
        f"comment {_AXES}",
        f"element vertex {len(table)}",
        *(f"property {_PLY_TYPES[values.dtype.name]} {name}" for name, values in columns.items()),
        "end_header",
    ]
    path.write_bytes(("\n".join(header) + "\n").encode("ascii") + table.tobytes())
