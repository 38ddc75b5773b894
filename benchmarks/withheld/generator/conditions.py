"""What happens around a recording: exposure, heat, room temperature, background light."""

from dataclasses import dataclass, replace

import numpy as np

from benchmarks.withheld.generator.poses import Design, Trajectory
from benchmarks.withheld.generator.rigid import Array

EXPOSURE_LEVELS = np.array([520.0, 680.0, 890.0, 1170.0, 1530.0])  # us
NOMINAL_EXPOSURE = 900.0  # us
LAG = 240.0  # s, of the electronics behind the room
BODY_RISE = (3.0, 9.0)  # degrees by the fast and the slow heat


@dataclass(frozen=True)
class Conditions:
    """One value per frame; `fast_heat` and `slow_heat` go from 0 (cold) to 1 (warm).

    `heat_seconds` are the time constants of the two.
    """

    exposure: Array  # us
    fast_heat: Array
    slow_heat: Array
    body_temperature: Array  # degrees Celsius, as logged
    room_temperature: Array
    lagged_room: Array  # what reached the electronics
    ambient: Array
    heat_seconds: tuple[float, float]


def draw_conditions(
    rng: np.random.Generator, design: Design, trajectory: Trajectory, brightness: Array
) -> Conditions:
    """Draw the conditions; `brightness` (N,) steers the automatic exposure."""
    t = trajectory.timestamps
    seconds = rng.uniform(100.0, 200.0), rng.uniform(800.0, 1300.0)
    fast, slow = (_heat(t, one) for one in seconds)
    clock, room, lagged = _room(rng, t)
    body = np.interp(t, clock, lagged) + BODY_RISE[0] * fast + BODY_RISE[1] * slow
    return Conditions(
        exposure=_exposure(rng, design, trajectory.pose_id, brightness),
        fast_heat=fast,
        slow_heat=slow,
        body_temperature=body + rng.normal(0, 0.05, len(t)),
        room_temperature=np.interp(t, clock, room) + rng.normal(0, 0.03, len(t)),
        lagged_room=np.interp(t, clock, lagged),
        ambient=_ambient(rng, t, trajectory.pose_id),
        heat_seconds=seconds,
    )


def after_rest(
    session: Conditions, timestamps: Array, heat_seconds: tuple[float, float]
) -> Conditions:
    """The conditions of a session whose columns hold all that the camera's delay depends on.

    The camera stood switched off in the room until the first frame, and between frames the room's
    temperature changes linearly. What no column holds, no sensor can foretell. `heat_seconds` are
    those of the camera: another session does not change them.
    """
    fast, slow = (_heat(timestamps, one) for one in heat_seconds)
    clock = np.arange(0.0, timestamps[-1] + 10.0, 5.0)
    room = np.interp(clock, timestamps, session.room_temperature)
    lagged = np.interp(timestamps, clock, _lagged(clock, room))
    warmer = BODY_RISE[0] * (fast - session.fast_heat) + BODY_RISE[1] * (slow - session.slow_heat)
    return replace(
        session,
        fast_heat=fast,
        slow_heat=slow,
        lagged_room=lagged,
        body_temperature=session.body_temperature + warmer + lagged - session.lagged_room,
        heat_seconds=heat_seconds,
    )


def _exposure(
    rng: np.random.Generator, design: Design, pose_id: np.ndarray, brightness: Array
) -> Array:
    levels = EXPOSURE_LEVELS * rng.uniform(0.95, 1.05)
    if design.exposure == "constant":
        return np.full(len(pose_id), levels[2])
    if design.exposure == "automatic":
        wanted = NOMINAL_EXPOSURE * np.median(brightness) / brightness
        return np.round(np.clip(wanted, 250.0, 3500.0) / 10.0) * 10.0
    return levels[rng.integers(len(levels), size=pose_id[-1] + 1)][pose_id]


def _heat(timestamps: Array, seconds: float) -> Array:
    """Warm up while frames come, cool down (half as fast) in longer gaps; cold at the start."""
    heat = np.zeros(len(timestamps))
    for i, gap in enumerate(np.diff(timestamps), start=1):
        on, off = min(gap, 150.0), max(gap - 150.0, 0.0)
        heat[i] = 1 - (1 - heat[i - 1] * np.exp(-off / (2 * seconds))) * np.exp(-on / seconds)
    return heat


def _room(rng: np.random.Generator, timestamps: Array) -> tuple[Array, Array, Array]:
    """A thermostat's saw-tooth over a slow drift, and the same after a lag."""
    clock = np.arange(-1200.0, timestamps[-1] + 10.0, 5.0)
    period, start = rng.uniform(500.0, 900.0), rng.uniform(0, 1)
    tooth = np.abs(2 * ((clock / period + start) % 1) - 1) - 0.5
    swing = np.sin(2 * np.pi * (clock / rng.uniform(2000.0, 4000.0) + rng.uniform(0, 1)))
    room = 22.0 + rng.normal(0, 1) + rng.uniform(2.0, 3.5) * tooth + rng.uniform(0.8, 1.6) * swing
    return clock, room, _lagged(clock, room)


def _lagged(clock: Array, room: Array) -> Array:
    """What follows the room with a lag, from rest."""
    lagged, step = room.copy(), clock[1] - clock[0]
    for i in range(1, len(clock)):
        lagged[i] = lagged[i - 1] + (room[i] - lagged[i - 1]) * (1 - np.exp(-step / LAG))
    return lagged


def _ambient(rng: np.random.Generator, timestamps: Array, pose_id: np.ndarray) -> Array:
    """A lamp at one of three settings, and daylight that drifts."""
    lamp = np.array([0.0, 0.35, 1.0])[rng.integers(3, size=pose_id[-1] + 1)][pose_id]
    daylight = 0.12 + 0.08 * np.sin(timestamps / rng.uniform(300.0, 900.0) + rng.uniform(0, 6))
    return lamp + daylight
