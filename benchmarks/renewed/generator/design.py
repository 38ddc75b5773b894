"""How a recording is laid out: frames, distances, stations, scene, mask."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from benchmarks.renewed.generator import ranges

INDOORS = ("floor", "corner", "closed")


@dataclass(frozen=True)
class Design:
    """One layout; lengths in metres, angles in radians."""

    frames: int
    near: float
    far: float
    tilt: float
    moving: bool
    repeated: float
    repeats: int
    robot: float
    scene: str
    target: str
    mask: str
    ransac: float
    exposure: str
    logged: tuple[str, ...]  # optional columns of frames.csv that are written


def draw_design(
    rng: np.random.Generator, pixels: int, near: float, far: float, wanted: Mapping[str, Any]
) -> Design:
    """Draw a design; `wanted` fixes what an effect cannot do without."""
    frames = min(ranges.draw_of(ranges.FRAMES, rng), max(15, int(ranges.MOST_PIXELS / pixels)))
    drawn = {
        "frames": frames,
        "near": near,
        "far": far,
        "tilt": np.deg2rad(ranges.TILT_DEG.draw(rng)),
        "moving": bool(rng.uniform() < ranges.ON_THE_MOVE),
        "repeated": ranges.draw_of(ranges.REPEATED, rng),
        "repeats": ranges.draw_of(ranges.REPEATS, rng),
        "robot": 1e-3 * ranges.ROBOT_MM.draw(rng),
        "scene": ranges.draw_of(ranges.SCENES, rng),
        "target": ranges.draw_of(ranges.TARGETS, rng),
        "mask": ranges.draw_of(ranges.MASKS, rng),
        "ransac": max(
            ranges.RANSAC_SHARE.draw(rng) * np.sqrt(near * far), 1e-3 * ranges.LEAST_RANSAC_MM
        ),
        "exposure": ranges.draw_of(ranges.EXPOSURES, rng),
    }
    optional = ("integration_time_us", "body_temperature_c", "room_temperature_c", "ambient")
    needed = wanted.get("logged", ())
    logged = [name for name in optional if rng.uniform() < ranges.LOGGED or name in needed]
    known = {key: value for key, value in wanted.items() if key != "logged"}
    layout = drawn | known
    if layout["moving"] and layout["scene"] in INDOORS:
        layout["scene"] = "wall"  # a way without stops would lead through floor and walls
    return Design(**layout, logged=tuple(logged))
