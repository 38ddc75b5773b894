"""The benchmark's own reader of the recordings it wrote, for oracle and baselines."""

import csv
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import yaml

from benchmarks.withheld.generator.camera import Camera
from benchmarks.withheld.generator.rigid import Array, transforms


@dataclass(frozen=True)
class Data:
    """A recording; arrays of frames have N rows."""

    rays: Array  # (H, W, 3)
    depth: Array  # (N, H, W) radial, metres
    depth_per_range: Array  # (H, W): the recording's depth over the radial distance
    amplitude: Array | None
    valid: np.ndarray  # (N, H, W)
    world_from_tool: Array  # (N, 4, 4)
    normal: Array  # (N, 3)
    offset: Array  # (N,)
    tool_from_camera: Array  # (4, 4), the guess
    columns: dict[str, Array]  # numeric columns of frames.csv that are there
    checkerboard: np.ndarray  # (N,) bool

    @property
    def moves(self) -> bool:
        """Whether there is a robot, and so a hand-eye transform to estimate."""
        return bool(np.abs(self.world_from_tool - np.eye(4)).max() > 1e-12)


def read(folder: Path) -> Data:
    """Read a recording folder."""
    about = yaml.safe_load((folder / "recording.yaml").read_text())
    with (folder / "frames.csv").open() as file:
        rows = list(csv.DictReader(file))
    columns = {
        name: np.array([float(row[name]) for row in rows]) for name in rows[0] if name != "target"
    }
    depth = np.load(folder / "depth.npy").astype(float)
    rays = _camera(about["camera"]).rays()
    per_range = rays[..., 2] if about["depth_kind"] == "z" else np.ones(rays.shape[:2])
    stored = folder / "amplitude.npy"
    x, y, z, w = np.stack([columns[name] for name in ("qx", "qy", "qz", "qw")])
    rotation = np.stack(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    ).transpose(2, 0, 1)
    amplitude = np.load(stored).astype(float) if stored.exists() else None
    limit = about["saturation_amplitude"]
    lit = amplitude < limit if amplitude is not None and limit is not None else True
    return Data(
        rays=rays,
        depth=depth / per_range,
        depth_per_range=per_range,
        amplitude=amplitude,
        valid=(np.load(folder / "mask.npy") > 0) & np.isfinite(depth) & (depth > 0) & lit,
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
