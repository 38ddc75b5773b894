"""A recording as point clouds in the camera's frame, before and after correction."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch

from tofcorr.data.corrected import Corrector, corrected_frames
from tofcorr.data.ply import write_ply
from tofcorr.data.recording import Recording
from tofcorr.files.staged import StagedFolder
from tofcorr.geometry.rays import ray_directions

_AXES = "camera frame, metres: x right, y down, z forward (optical frame of REP 103)"


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
        corrector: Takes depth and amplitude, shape (1, H, W), float32, and gives corrected depth
            and where it is valid.
        recording: What to correct.
        path: The folder, which must not exist yet.
        progress: Called with the number of frames that were just written.

    Raises:
        CalibrationDataError: `path` exists, the disk refuses, or `recording` is broken.
    """
    rays = ray_directions(recording.camera)
    per_depth = rays / rays[..., 2:] if recording.depth_kind == "z" else rays
    directions = per_depth.numpy()
    digits = max(3, len(str(recording.num_frames - 1)))
    with StagedFolder(path) as stage, torch.inference_mode():
        for number, one in enumerate(corrected_frames(corrector, recording, 1)):
            name = stage.folder / f"frame_{number:0{digits}d}"
            extra = {} if one.amplitude is None else {"amplitude": one.amplitude[0]}
            _write(Path(f"{name}_before.ply"), one.depth[0], directions, extra)
            extra["valid"] = one.kept[0].astype(np.uint8)
            _write(Path(f"{name}_after.ply"), one.corrected[0], directions, extra)
            progress(1)


def _write(
    path: Path, depth: np.ndarray, directions: np.ndarray, extra: dict[str, np.ndarray]
) -> None:
    """Write the points of one image (H, W) with further properties (H, W)."""
    returned = np.isfinite(depth) & (depth > 0)
    points = (directions[returned] * depth[returned][:, None].astype(np.float64)).astype(np.float32)
    columns = {axis: points[:, k] for k, axis in enumerate("xyz")}
    columns |= {name: image[returned] for name, image in extra.items()}
    write_ply(path, columns, (_AXES,))
