"""Where the camera stands: random stations, strokes on the move, sorted and untilted designs."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from benchmarks.withheld.generator.rigid import Array, rotations, transforms

MAX_TILT = np.deg2rad(34.0)
STATION = ("distance", "tilt_x", "tilt_y", "roll", "look_x", "look_y")


@dataclass(frozen=True)
class Design:
    """How a recording is laid out; the defaults are the well-posed one."""

    frames: int = 60
    moving: bool = False  # strokes recorded on the move instead of stations
    order: str = "random"  # or "sorted": from near to far
    tilt: bool = True
    exposure: str = "random"  # or "constant", "automatic"
    targets: str = "mixed"  # or "white"
    repeats: int = 0  # stations visited for three frames each


@dataclass(frozen=True)
class Trajectory:
    """The camera's way relative to the target as a function of time."""

    timestamps: Array  # (N,) s
    pose_id: np.ndarray  # (N,) int
    camera_at: Callable[
        [Array], Array
    ]  # offset in time from each frame's stamp (N,) -> target_from_camera (N, 4, 4)


def draw_trajectory(rng: np.random.Generator, design: Design) -> Trajectory:
    """Draw times and poses of a design."""
    return _strokes(rng, design) if design.moving else _stations(rng, design)


def _stations(rng: np.random.Generator, design: Design) -> Trajectory:
    n = design.frames
    pose_id = _repeated(rng, n, design.repeats)
    stations = _draw_stations(rng, pose_id[-1] + 1, design)
    if design.order == "sorted":
        stations = stations[np.argsort(stations[:, 0])]
    gaps = np.where(
        np.diff(pose_id, prepend=-1) > 0, rng.uniform(18.0, 42.0, n), rng.uniform(0.4, 0.6, n)
    )
    for pause in rng.choice(np.flatnonzero(np.diff(pose_id, prepend=0) > 0), size=2, replace=False):
        gaps[pause] += rng.uniform(240.0, 800.0)
    gaps[0] = 0.0
    fixed = _camera_poses(stations[pose_id])
    return Trajectory(
        np.cumsum(gaps), pose_id, lambda offset: np.broadcast_to(fixed, (len(offset), 4, 4))
    )


def _repeated(rng: np.random.Generator, frames: int, repeats: int) -> np.ndarray:
    """Pose numbers in which `repeats` stations come three times in a row, the others once."""
    stations = frames - 2 * repeats
    times = np.ones(stations, dtype=int)
    times[rng.choice(stations, size=repeats, replace=False)] = 3
    return np.repeat(np.arange(stations), times)


def _strokes(rng: np.random.Generator, design: Design) -> Trajectory:
    n, length, period = design.frames, 6, 0.25
    stroke = np.arange(n) // length
    within = (np.arange(n) % length - (length - 1) / 2) * period
    starts = np.cumsum(rng.uniform(60.0, 140.0, stroke[-1] + 1))
    timestamps = starts[stroke] - starts[0] + within - within[0] + rng.uniform(-0.01, 0.01, n)
    timestamps -= timestamps[0]
    middle = _draw_stations(rng, stroke[-1] + 1, design)
    speed = rng.uniform(0.2, 0.6, len(middle)) * rng.choice([-1.0, 1.0], len(middle))
    rates = np.column_stack([speed, rng.normal(0, [0.1, 0.1, 0.1, 0.05, 0.05], (len(middle), 5))])
    sway = rng.normal(0, [0.01, 0.01, 0.01, 0.01, 0.01, 0.01], (len(middle), 6))
    seconds = timestamps - (starts[stroke] - starts[0] + 2.5 * period)

    def camera_at(offset: Array) -> Array:
        t = (seconds + offset)[:, None]
        return _camera_poses(middle[stroke] + rates[stroke] * t + sway[stroke] * np.sin(2.2 * t))

    return Trajectory(timestamps, np.arange(n), camera_at)


def _draw_stations(rng: np.random.Generator, n: int, design: Design) -> Array:
    margin = 0.4 if design.moving else 0.0
    distance = (
        0.5
        + margin
        + (1.5 - 2 * margin) * rng.permutation((np.arange(n) + rng.uniform(0, 1, n)) / n)
    )
    tilt = rng.uniform(-MAX_TILT, MAX_TILT, (n, 2)) * (1.0 if design.tilt else 0.0)
    roll = rng.uniform(-1.2, 1.2, n)
    look = rng.uniform(-0.22, 0.22, (n, 2))
    return np.column_stack([distance, tilt, roll, look])


def _camera_poses(station: Array) -> Array:
    """target_from_camera (N, 4, 4) of cameras that face the target's z = 0 from their stations."""
    distance, tilt_x, tilt_y, roll, look_x, look_y = station.T
    zero = np.zeros_like(roll)
    facing = np.diag([1.0, -1.0, -1.0])
    turn = rotations(np.stack([tilt_x, zero, zero], -1)) @ rotations(
        np.stack([zero, tilt_y, zero], -1)
    )
    rotation = turn @ facing @ rotations(np.stack([zero, zero, roll], -1))
    looked_at = np.stack([look_x, look_y, zero], -1)
    return transforms(rotation, looked_at - distance[:, None] * rotation[..., 2])
