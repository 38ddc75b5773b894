"""Effects that no catalogue has by name: the right answer is "unknown", or nothing."""

import numpy as np

from benchmarks.renewed.geometry import Random
from benchmarks.renewed.signal_chain import Change, adding, form
from benchmarks.renewed.world import World


@form("interference", "path", 0.005)
def interference(rng: Random, world: World) -> Change:
    """Another camera's light beats with this one: slanted stripes that move from frame to frame."""
    column, row = world.pixel_position
    along = rng.normal(0, 6, 2)
    start = rng.uniform(0, 2 * np.pi, world.frames)[:, None, None]
    return adding(np.sin(along[0] * column + along[1] * row + start))


@form("parallax", "path", 0.005)
def parallax(rng: Random, world: World) -> Change:
    """Two lamps beside the lens, one of them late: near pixels see more of one or the other."""
    column, _ = world.pixel_position
    near = rng.choice([-1.0, 1.0]) * world.design.near
    return adding(lambda view: np.tanh(3 * column * near / view.distance))


@form("every_other", "path", 0.005, moving=False, repeated=0.0)
def every_other(rng: Random, world: World) -> Change:
    """Two buffers take turns; one of them is late in the lower part of the image."""
    _, row = world.pixel_position
    turn = (np.arange(world.frames) % 2)[:, None, None]
    return adding(turn * (row > -1 / 3))
