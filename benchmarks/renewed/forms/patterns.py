"""Forms of what belongs to a pixel, a row or a column."""

import numpy as np

from benchmarks.renewed.geometry import Random
from benchmarks.renewed.signal_chain import Change, adding, form
from benchmarks.renewed.world import World


def _shape(world: World) -> tuple[int, int]:
    return world.sensor.lens.height, world.sensor.lens.width


@form("fixed_pattern", "path", 0.005, textbook=True)
def every_pixel(rng: Random, world: World) -> Change:
    """Every pixel has a delay of its own."""
    return adding(rng.standard_normal(_shape(world)))


@form("fixed_pattern", "path", 0.02)
def hot_pixels(rng: Random, world: World) -> Change:
    """Few pixels, in clusters, are far off."""
    shape = _shape(world)
    seeds = rng.uniform(size=shape) < rng.uniform(0.01, 0.04)
    beside = np.roll(seeds, 1, 1) & (rng.uniform(size=shape) < 0.5)
    return adding((seeds | np.roll(seeds, 1, 0) | beside) * rng.normal(0.5, 1.0, shape))


@form("fixed_pattern", "path", 0.005)
def blocks(rng: Random, world: World) -> Change:
    """Pixels are read out in blocks, each by a circuit of its own."""
    height, width = _shape(world)
    size = int(rng.integers(4, 9))
    table = rng.standard_normal((height // size + 1, width // size + 1))
    return adding(table.repeat(size, 0).repeat(size, 1)[:height, :width])


@form("row_column_pattern", "path", 0.005, textbook=True)
def free_columns(rng: Random, world: World) -> Change:
    """Every column has an offset of its own, and rows a smaller one."""
    height, width = _shape(world)
    return adding(rng.standard_normal(width) + 0.4 * rng.standard_normal(height)[:, None])


@form("row_column_pattern", "path", 0.005)
def halves_and_pairs(rng: Random, world: World) -> Change:
    """Odd and even rows by two converters, and a step where the two halves of the array meet."""
    height, width = _shape(world)
    rows = (np.arange(height) % 2 - 0.5) * rng.uniform(0.5, 2.0)
    half = np.arange(width) >= width // 2
    return adding(rows[:, None] + half * rng.uniform(0.5, 2.0) * rng.choice([-1.0, 1.0]))


@form("row_column_pattern", "path", 0.005)
def clock_beat(rng: Random, world: World) -> Change:
    """The row clock beats with the modulation: a wave down the image that stands still."""
    height, width = _shape(world)
    period = rng.uniform(3.0, 9.0)
    wave = np.sin(2 * np.pi * np.arange(height) / period + rng.uniform(0, 6))
    return adding(np.broadcast_to(wave[:, None], (height, width)))
