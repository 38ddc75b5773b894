"""A small camera before a wall, and what its simulation writes."""

from pathlib import Path
from typing import Any

import torch

from tofcorr.simulation.hooks import FrameState
from tofcorr.simulation.options import SimulatorOptions
from tofcorr.simulation.robot import draw_plan
from tofcorr.simulation.simulator import take_frames

CAMERA = {
    "width": 16,
    "height": 12,
    "K": [[20.0, 0.0, 7.6], [0.0, 20.0, 5.4], [0.0, 0.0, 1.0]],
    "distortion": [-0.08, 0.02, 0.0005, -0.0004, 0.0],
}
IMPERFECT: dict[str, Any] = {
    "harmonics": [{"order": 3, "share": 0.01}, {"order": 5, "share": 0.004}],
    "delays": {
        "constant_mm": 25.0,
        "clock_deviation": 0.002,
        "pixel": {"row_line_mm": 5.0, "bowl_mm": 4.0, "irregular_mm": 1.0},
        "amplitude": {"law": "power", "scale_mm": 6.0, "exponent": 0.4},
    },
}
"""A sensor with every error that the plain simulator knows."""


def small(**sections: Any) -> SimulatorOptions:
    """Return options: a small camera, four white and three checkered poses."""
    values: dict[str, Any] = {
        "camera": CAMERA,
        "shots": [{"target": "white", "poses": 4}, {"target": "checkerboard", "poses": 3}],
    }
    robot = {"farthest_pixel_m": None} | sections.pop("robot", {})
    return SimulatorOptions.from_mapping(values | {"robot": robot} | sections, "test")


def planned(options: SimulatorOptions) -> list[FrameState]:
    """Return the frames of a recording before they are simulated."""
    return draw_plan(options, torch.Generator().manual_seed(options.seed))


def expected_frames(options: SimulatorOptions) -> list[FrameState]:
    """Return the frames of a recording without noise."""
    return list(take_frames(options, planned(options), None))


def files_in(folder: Path) -> dict[str, bytes]:
    """Return what a simulation wrote, byte by byte."""
    files = (path for path in sorted(folder.rglob("*")) if path.is_file())
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in files}
