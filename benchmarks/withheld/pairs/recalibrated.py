"""Ideal frames rendered again with the hand-eye transform that a diagnosis found.

A sensor's errors and its hand-eye transform are found together: a shift along the ray and a
constant, or a turn and a principal point, hardly differ in the data. So whoever degrades frames
recalibrates the simulator first, as the report says.
"""

import shutil
from pathlib import Path

import numpy as np
import yaml

from benchmarks.withheld.reading import read


def recalibrated(ideal: Path, sensor: Path, out: Path) -> Path:
    """Write ideal frames of planes again, from where the sensor has the camera; return `out`."""
    found = yaml.safe_load(sensor.read_text())["tool_from_camera"]
    shutil.copytree(ideal, out)
    data = read(ideal)
    poses = data.world_from_tool @ np.array(found)
    radial = np.stack(
        [
            -(normal @ pose[:3, 3] + offset) / (data.rays @ pose[:3, :3].T @ normal)
            for pose, normal, offset in zip(poses, data.normal, data.offset, strict=True)
        ]
    )
    seen = np.isfinite(data.depth) & (data.depth > 0)
    depth = np.where(seen, radial * data.depth_per_range, np.nan)
    np.save(out / "depth.npy", depth.astype(np.float32))
    header = yaml.safe_load((ideal / "recording.yaml").read_text()) | {"tool_from_camera": found}
    (out / "recording.yaml").write_text(yaml.safe_dump(header))
    return out
