"""What is done to a recording after the camera: arrays withheld, pixels spoilt, planes by a board.

Each takes a folder written by the renewed generator, and changes its files.
"""

import csv
import json
from collections.abc import Callable
from pathlib import Path

import numpy as np

from benchmarks.renewed.generator.recording import Recorded, depth_over_range
from benchmarks.withheld.generator.rigid import inverse, small_motions

Fault = Callable[[Path, Recorded, np.random.Generator], None]

BOARD = (1e-3, 2e-3)  # metres and radians, each axis: errors of a board's pose
OFF_SHARE, OFF_BY = 0.03, 0.7  # of the pixels; metres
NO_ROBOT = {"tx": 0, "ty": 0, "tz": 0, "qx": 0, "qy": 0, "qz": 0, "qw": 1}


def without_amplitude(folder: Path, recorded: Recorded, rng: np.random.Generator) -> None:
    """The camera gives depth alone."""
    (folder / "amplitude.npy").unlink()


def far_pixels(folder: Path, recorded: Recorded, rng: np.random.Generator) -> None:
    """Single pixels are far off, and the mask has them."""
    depth = np.load(folder / "depth.npy")
    off = rng.uniform(size=depth.shape) < OFF_SHARE
    depth += off * OFF_BY * depth_over_range(recorded.world)
    np.save(folder / "depth.npy", depth.astype(np.float32))


def board_planes(folder: Path, recorded: Recorded, rng: np.random.Generator) -> None:
    """No robot: each pose's plane comes from the picture of a board, with its errors."""
    world = recorded.world
    count = int(world.way.pose_id[-1]) + 1
    draws = (size * rng.standard_normal((count, 3)) for size in BOARD)
    true = inverse(world.world_from_tool() @ world.tool_from_camera) @ world.world_from_target
    board = small_motions(*draws)[world.way.pose_id] @ true
    normal = board[:, :3, 2]
    offset = -(normal * board[:, :3, 3]).sum(-1)
    with (folder / "frames.csv").open() as file:
        rows = list(csv.DictReader(file))
    for row, n, d in zip(rows, normal, offset, strict=True):
        row.update(NO_ROBOT | dict(zip(("nx", "ny", "nz", "d"), (*n, d), strict=True)))
    with (folder / "frames.csv").open("w", newline="") as file:
        writer = csv.DictWriter(file, list(rows[0]))
        writer.writeheader()
        writer.writerows(rows)
    about = folder / "recording.yaml"
    lines = [line for line in about.read_text().splitlines() if "tool_from_camera" not in line]
    lines.append(f"tool_from_camera: {json.dumps(np.eye(4).tolist())}")
    about.write_text("\n".join(lines) + "\n")
