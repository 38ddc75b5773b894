"""Effects that no catalogue has."""

import numpy as np

from benchmarks.withheld.generator.effect import Effect
from benchmarks.withheld.generator.observe import View
from benchmarks.withheld.generator.rigid import Array


def mirror_ghost(rng: np.random.Generator) -> Effect:
    """A reflection between lens elements: the image turned half round about its centre or near."""
    shift = tuple(int(i) for i in rng.integers(-3, 4, 2))
    delay = rng.uniform(0.05, 0.3)

    def change(strength: float, view: View, phasor: Array) -> Array:
        turn = np.exp(2j * np.pi * delay / view.world.camera.unambiguous_range)
        return phasor + strength * turn * np.roll(phasor[:, ::-1, ::-1], shift, (1, 2))

    return Effect("mirror_ghost", "light", change, 0.02)


def stripes(rng: np.random.Generator) -> Effect:
    """Interference that beats with the row clock and starts anywhere in every frame."""
    seed, rows = int(rng.integers(2**32)), rng.uniform(5.0, 16.0)

    def change(strength: float, view: View, path: Array) -> Array:
        start = np.random.default_rng(seed).uniform(0, 2 * np.pi, (view.world.frames, 1, 1))
        row = np.arange(view.world.camera.height)[:, None]
        return path + strength * np.sin(2 * np.pi * row / rows + start)

    return Effect("stripes", "path", change, 0.005)


def third_frame(rng: np.random.Generator) -> Effect:
    """Every third frame comes from a buffer with another delay."""
    which, sign = int(rng.integers(3)), rng.choice([-1.0, 1.0])

    def change(strength: float, view: View, path: Array) -> Array:
        return path + sign * strength * (np.arange(view.world.frames) % 3 == which)[:, None, None]

    return Effect("third_frame", "path", change, 0.01)


def frame_lag(rng: np.random.Generator) -> Effect:
    """A part of the previous frame stays in the pixels."""
    del rng

    def change(strength: float, view: View, phasor: Array) -> Array:
        previous = np.concatenate([phasor[:1], phasor[:-1]])
        return phasor + strength * previous

    return Effect("frame_lag", "light", change, 0.02)


def corner_dent(rng: np.random.Generator) -> Effect:
    """A smear on the lens in one corner of the image, worse the farther the target."""
    corner, width = rng.choice([-0.7, 0.7], 2), rng.uniform(0.25, 0.45)

    def change(strength: float, view: View, path: Array) -> Array:
        column, row = view.world.pixel_position
        dent = np.exp(-((column - corner[0]) ** 2 + (row - corner[1]) ** 2) / (2 * width**2))
        return path + strength * dent * view.distance**2

    return Effect("corner_dent", "path", change, 0.01)
