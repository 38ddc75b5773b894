"""Cameras that drifted, and a few frames of them."""

from collections.abc import Callable
from typing import Any

from simulated_walls import QUIET, SENSOR

from tofcorr.pixels.dataset import Dataset

FEW = (("white", 4), ("checkerboard", 4))


def sensor(shift_mm: float = 0.0) -> dict[str, Any]:
    delays = SENSOR["delays"] | {"constant_mm": 18.0 + shift_mm}
    return SENSOR | QUIET | {"delays": delays}


Walls = Callable[..., Dataset]
