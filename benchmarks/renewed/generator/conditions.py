"""What happens around a recording, frame by frame."""

from dataclasses import dataclass

import numpy as np

from benchmarks.renewed.generator import ranges
from benchmarks.renewed.generator.design import Design
from benchmarks.renewed.generator.stations import Way
from benchmarks.withheld.generator.rigid import Array

NOMINAL_US = 800.0


@dataclass(frozen=True)
class Conditions:
    """One value a frame."""

    exposure: Array  # us
    room: Array  # degrees Celsius
    body: Array
    ambient: Array  # background light, the camera's own units; the sun is not among it
    powered: float  # seconds of power before the first frame


def draw_conditions(rng: np.random.Generator, design: Design, way: Way) -> Conditions:
    """Draw the conditions of a way."""
    t, n = way.seconds, design.frames
    swing = ranges.ROOM_K.draw(rng)
    periods = rng.uniform(0.3, 2.5, 4) * max(t[-1], 60.0)
    waves = np.sin(2 * np.pi * t[:, None] / periods + rng.uniform(0, 2 * np.pi, 4)).sum(1)
    room = rng.uniform(17.0, 26.0) + swing * (waves - waves.min()) / max(np.ptp(waves), 1e-6)
    powered = rng.uniform(0.0, 60.0)
    levels = rng.uniform(0, 1.5, rng.integers(2, 5))
    lamp = levels[rng.integers(len(levels), size=int(way.pose_id[-1]) + 1)][way.pose_id]
    return Conditions(
        exposure=_exposure(rng, design, way),
        room=room,
        body=room + 11.0 * heat(way, powered, 500.0) + rng.normal(0, 0.08, n),
        ambient=lamp + 0.1 * (1 + np.sin(t / 700.0)),
        powered=powered,
    )


def heat(way: Way, powered: float, constant: float) -> Array:
    """Share of full warmth (N,) by Newton's law; pauses cool at the same rate."""
    level, result = 1 - np.exp(-powered / constant), np.empty(len(way.seconds))
    before = 0.0
    for i, (now, pause) in enumerate(zip(way.seconds, way.pauses, strict=True)):
        level *= np.exp(-pause / constant)
        level = 1 - (1 - level) * np.exp(-(now - before - pause) / constant)
        result[i], before = level, now
    return result


def _exposure(rng: np.random.Generator, design: Design, way: Way) -> Array:
    levels = NOMINAL_US * np.exp(np.linspace(-1, 1, rng.integers(3, 7)) * rng.uniform(0.4, 1.1))
    n = design.frames
    if design.exposure == "constant":
        return np.full(n, levels[0])
    if design.exposure == "bracketed":  # at one pose as well
        return levels[rng.integers(len(levels), size=n)]
    if design.exposure == "automatic":
        z = way.camera_at(np.zeros(n))[:, 2, 3]
        wanted = NOMINAL_US * (z**2 / (design.near * design.far)) ** 0.8
        return np.round(np.clip(wanted, 100.0, 8000.0) / 50.0) * 50.0
    return levels[rng.integers(len(levels), size=int(way.pose_id[-1]) + 1)][way.pose_id]
