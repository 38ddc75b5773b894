"""Ideal frames rendered again with the hand-eye transform that a diagnosis found.

A sensor's errors and its hand-eye transform are found together: a shift along the ray and a
constant, or a turn and a principal point, hardly differ in the data. So whoever degrades frames
recalibrates the simulator first, as the report says.
"""

import shutil
from pathlib import Path

import numpy as np
import yaml


def recalibrated(ideal: Path, sensor: Path, out: Path) -> Path:
    """Write ideal frames of planes again, from where the sensor has the camera; return `out`."""
    from tofcorr.data.recording import Recording
    from tofcorr.geometry.rays import ray_directions

    found = yaml.safe_load(sensor.read_text())["tool_from_camera"]
    shutil.copytree(ideal, out)
    recording = Recording.open(ideal)
    rays, frames = ray_directions(recording.camera).numpy(), recording.frames
    old = np.load(ideal / "depth.npy")
    depth = []
    poses = frames.world_from_tool @ np.array(found)
    for pose, normal, offset in zip(poses, frames.normal_world, frames.offset, strict=True):
        radial = -(normal @ pose[:3, 3] + offset) / (rays @ pose[:3, :3].T @ normal)
        depth.append(radial * (rays[..., 2] if recording.depth_kind == "z" else 1.0))
    seen = np.isfinite(old) & (old > 0)
    np.save(out / "depth.npy", np.where(seen, np.array(depth), np.nan).astype(np.float32))
    header = yaml.safe_load((ideal / "recording.yaml").read_text()) | {"tool_from_camera": found}
    (out / "recording.yaml").write_text(yaml.safe_dump(header))
    return out
