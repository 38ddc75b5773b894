"""The benchmark's own reader of the recordings it wrote, for oracle and baselines."""

import csv
import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from benchmarks.withheld.generator.camera import Camera
from benchmarks.withheld.generator.rigid import Array, transforms


@dataclass(frozen=True)
class Data:
    """A recording; arrays of frames have N rows."""

    rays: Array  # (H, W, 3)
    depth: Array  # (N, H, W) radial, metres
    amplitude: Array | None
    valid: np.ndarray  # (N, H, W)
    world_from_tool: Array  # (N, 4, 4)
    normal: Array  # (N, 3)
    offset: Array  # (N,)
    tool_from_camera: Array  # (4, 4), the guess
    columns: dict[str, Array]  # numeric columns of frames.csv that are there
    checkerboard: np.ndarray  # (N,) bool


def read(folder: Path) -> Data:
    """Read a recording folder."""
    lines = (folder / "recording.yaml").read_text().splitlines()
    about = {key: json.loads(value) for key, _, value in (line.partition(": ") for line in lines)}
    with (folder / "frames.csv").open() as file:
        rows = list(csv.DictReader(file))
    columns = {
        name: np.array([float(row[name]) for row in rows]) for name in rows[0] if name != "target"
    }
    depth = np.load(folder / "depth.npy").astype(float)
    stored = folder / "amplitude.npy"
    x, y, z, w = np.stack([columns[name] for name in ("qx", "qy", "qz", "qw")])
    rotation = np.stack(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    ).transpose(2, 0, 1)
    return Data(
        rays=_camera(about["camera"]).rays(),
        depth=depth,
        amplitude=np.load(stored).astype(float) if stored.exists() else None,
        valid=(np.load(folder / "mask.npy") > 0) & np.isfinite(depth),
        world_from_tool=transforms(
            rotation, np.stack([columns[name] for name in ("tx", "ty", "tz")], -1)
        ),
        normal=np.stack([columns[name] for name in ("nx", "ny", "nz")], -1),
        offset=columns["d"],
        tool_from_camera=np.array(about["tool_from_camera"]),
        columns=columns,
        checkerboard=np.array([row["target"] == "checkerboard" for row in rows]),
    )


def _camera(about: dict) -> Camera:
    matrix = about["K"]
    return Camera(
        width=about["width"],
        height=about["height"],
        focal=(matrix[0][0], matrix[1][1]),
        centre=(matrix[0][2], matrix[1][2]),
        distortion=tuple(about["distortion"]),
        modulation_frequency=1.0,
        sensitivity=1.0,
        counts_per_electron=1.0,
    )
