"""A small camera before a wall."""

from collections.abc import Callable
from typing import Any

import pytest

from tofcorr.simulation.options import SimulatorOptions

CAMERA = {
    "width": 16,
    "height": 12,
    "K": [[20.0, 0.0, 7.6], [0.0, 20.0, 5.4], [0.0, 0.0, 1.0]],
    "distortion": [-0.08, 0.02, 0.0005, -0.0004, 0.0],
}


@pytest.fixture
def small() -> Callable[..., SimulatorOptions]:
    """Return a maker of options: a small camera, four white and three checkered poses."""

    def make(**sections: Any) -> SimulatorOptions:
        values: dict[str, Any] = {
            "camera": CAMERA,
            "shots": [{"target": "white", "poses": 4}, {"target": "checkerboard", "poses": 3}],
            "robot": {"farthest_pixel_m": None},
        }
        return SimulatorOptions.from_mapping(values | sections, "test")

    return make


@pytest.fixture
def imperfect_sensor() -> dict[str, Any]:
    """A sensor with every error that the plain simulator knows."""
    return {
        "harmonics": [{"order": 3, "share": 0.01}, {"order": 5, "share": 0.004}],
        "delays": {
            "constant_mm": 25.0,
            "clock_deviation": 0.002,
            "pixel": {"row_line_mm": 5.0, "bowl_mm": 4.0, "irregular_mm": 1.0},
            "amplitude": {"law": "power", "scale_mm": 6.0, "exponent": 0.4},
        },
    }
