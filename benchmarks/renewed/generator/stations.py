"""Where the camera stands and when: stations, repeats, or a way without stops."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from benchmarks.renewed.generator.design import Design
from benchmarks.renewed.transport.rooms import Room
from benchmarks.withheld.generator.rigid import Array, rotations, transforms

TRIES = 60
MARGIN = 0.1  # of the nearest distance, between camera and wall


@dataclass(frozen=True)
class Way:
    """The camera's way before the target."""

    seconds: Array  # (N,) time stamps
    pose_id: np.ndarray  # (N,)
    pauses: Array  # (N,) seconds of rest before each frame, beyond the usual
    camera_at: Callable[[Array], Array]  # seconds after each stamp (N,) -> target_from_camera


def draw_way(rng: np.random.Generator, design: Design, room: Room) -> Way:
    """Draw a way of a design that stays in a room."""
    return _moving(rng, design) if design.moving else _standing(rng, design, room)


def _standing(rng: np.random.Generator, design: Design, room: Room) -> Way:
    pose_id = _pose_ids(rng, design)
    new = np.diff(pose_id, prepend=-1) > 0
    n, count = design.frames, int(pose_id[-1]) + 1
    gaps = np.where(new, rng.uniform(4.0, 30.0) * rng.uniform(0.6, 1.4, n), rng.uniform(0.1, 0.5))
    pauses = np.zeros(n)
    later = np.flatnonzero(new)[1:]
    chosen = rng.choice(later, size=min(rng.integers(0, 3), len(later)), replace=False)
    pauses[chosen] = rng.uniform(200.0, 1200.0, len(chosen))
    gaps[0] = 0.0
    where = _camera(_indoors(rng, design, room, count))[pose_id]
    return Way(
        np.cumsum(gaps + pauses),
        pose_id,
        pauses,
        lambda late: np.broadcast_to(where, (len(late), 4, 4)),
    )


def _pose_ids(rng: np.random.Generator, design: Design) -> np.ndarray:
    """Numbers of stations; a share of them comes several times in a row."""
    ids: list[int] = []
    number = 0
    while len(ids) < design.frames:
        times = design.repeats if rng.uniform() < design.repeated else 1
        ids += [number] * times
        number += 1
    return np.array(ids[: design.frames])


def _moving(rng: np.random.Generator, design: Design) -> Way:
    """A sum of slow swings in every direction; frames every half second."""
    n = design.frames
    seconds = np.cumsum(np.append(0.0, 0.5 + rng.uniform(-0.05, 0.05, n - 1)))
    middle, half = (design.near + design.far) / 2, (design.far - design.near) / 2
    size = np.array([0.92 * half, design.tilt, design.tilt, 1.0, 0.12 * middle, 0.12 * middle])
    rate = (
        2
        * np.pi
        / rng.uniform([9.0, 6.0, 6.0, 14.0, 8.0, 8.0], [16.0, 12.0, 12.0, 30.0, 16.0, 16.0])
    )
    start = rng.uniform(0, 2 * np.pi, 6)

    def camera_at(late: Array) -> Array:
        place = size * np.sin(rate * (seconds + late)[:, None] + start)
        place[:, 0] += middle
        return _camera(place)

    return Way(seconds, np.arange(n), np.zeros(n), camera_at)


def _indoors(rng: np.random.Generator, design: Design, room: Room, count: int) -> Array:
    """Places (count, 6) between the walls: those outside are tilted anew, at last not at all."""
    places = _draw_places(rng, count, design)
    for attempt in range(TRIES):
        x, y = _camera(places)[:, :2, 3].T
        outside = np.zeros(count, dtype=bool)
        for wall, at in ((room.floor, y), (room.ceiling, y), (room.side, x), (room.other_side, x)):
            if wall is not None:
                outside |= at * np.sign(wall) > abs(wall) - MARGIN * design.near
        if not outside.any():
            break
        tilt = 0.0 if attempt == TRIES - 2 else design.tilt
        places[outside, 1:3] = rng.uniform(-tilt, tilt, (int(outside.sum()), 2))
    return places


def _draw_places(rng: np.random.Generator, count: int, design: Design) -> Array:
    """Distance, tilts, roll and the point looked at (count, 6); distances evenly, out of order."""
    share = rng.permutation((np.arange(count) + rng.uniform(0, 1, count)) / count)
    distance = design.near + (design.far - design.near) * share
    tilt = rng.uniform(-design.tilt, design.tilt, (count, 2))
    roll = rng.uniform(-1.5, 1.5, count) * rng.choice([0.3, 1.0])
    look = rng.uniform(-0.12, 0.12, (count, 2)) * np.sqrt(design.near * design.far)
    return np.column_stack([distance, tilt, roll, look])


def _camera(place: Array) -> Array:
    """target_from_camera (N, 4, 4): at a distance, tilted, rolled about its axis."""
    distance, tilt_x, tilt_y, roll, look_x, look_y = place.T
    zero = np.zeros_like(roll)
    facing = np.diag([1.0, -1.0, -1.0])
    turn = rotations(np.stack([tilt_x, tilt_y, zero], -1)) @ facing
    turn = turn @ rotations(np.stack([zero, zero, roll], -1))
    return transforms(turn, np.stack([look_x, look_y, zero], -1) - distance[:, None] * turn[..., 2])
