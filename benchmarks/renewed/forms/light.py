"""Forms of light that came another way: other walls, other pixels, other depths."""

from dataclasses import replace

import numpy as np

from benchmarks.renewed.geometry import SPEED_OF_LIGHT, Array, Random, inverse
from benchmarks.renewed.rendering import Room, indirect, smooth
from benchmarks.renewed.signal_chain import UNERODED, Change, View, coarse_points, form, see
from benchmarks.renewed.world import World

SUBPIXELS = 12  # rays that stand for a footprint


def _room(rng: Random, world: World, low: float, high: float) -> Room:
    return replace(world.surface.room, albedo=rng.uniform(low, high))


@form("multipath", "light", textbook=True, scaled=False, scene="floor", moving=False)
def rendered_floor(rng: Random, world: World) -> Change:
    """A bright floor before the target: all bounces between the two."""
    return rendered(world, _room(rng, world, 0.1, 0.8))


@form("multipath", "light", scaled=False, scene="corner", moving=False)
def rendered_corner(rng: Random, world: World) -> Change:
    """A floor and a side wall: all bounces."""
    return rendered(world, _room(rng, world, 0.08, 0.5))


@form("multipath", "light", scaled=False, scene="corner", moving=False)
def rendered_gloss(rng: Random, world: World) -> Change:
    """The same with a glossy side wall, in which the target sees itself lit."""
    return rendered(world, replace(_room(rng, world, 0.03, 0.2), gloss=rng.uniform(0.1, 0.35)))


@form("multipath", "light", scaled=False, scene="closed", moving=False)
def rendered_closed(rng: Random, world: World) -> Change:
    """A bright room, closed on all sides."""
    return rendered(world, _room(rng, world, 0.1, 0.5))


def rendered(world: World, room: Room) -> Change:
    """Indirect light over the direct one, rendered on a coarse grid for every frame."""
    inner = replace(world, surface=replace(world.surface, kind=("white",) * world.frames))
    cameras = inverse(world.world_from_target) @ world.world_from_tool() @ world.tool_from_camera
    points = _within(coarse_points(inner), room)
    light = indirect(room, cameras, points, world.sensor.frequencies, world.seed)
    lens = world.sensor.lens
    lines = np.linspace(-1, 1, lens.height), np.linspace(-1, 1, lens.width)
    shares = dict(zip(world.sensor.frequencies, light, strict=True))

    def change(strength: float, view: View, phasor: np.ndarray) -> np.ndarray:
        return phasor * (1 + strength * smooth(shares[view.frequency], *lines))

    return change


def _within(points: Array, room: Room) -> Array:
    """Points moved off the joints between target and walls, and not beyond them."""
    result = points.copy()
    for axis, wall in room.sides():
        clip = np.minimum if wall > 0 else np.maximum
        result[..., axis] = clip(result[..., axis], 0.98 * wall)
    return result


@form("multipath", "light", 0.02)
def housing(rng: Random, world: World) -> Change:
    """The robot's bright flange sends light back to the target: there and back twice."""

    def change(strength: float, view: View, phasor: np.ndarray) -> np.ndarray:
        turn = np.exp(4j * np.pi * view.frequency / SPEED_OF_LIGHT * view.distance)
        near = (world.design.near / view.distance) ** 2
        return phasor * (1 + strength * near * view.cosine * turn)

    return change


@form("stray_light", "light", 0.05, textbook=True, target="checkerboard")
def spread(rng: Random, world: World) -> Change:
    """Lens flare: the image spread by an exponential about every pixel."""
    length = world.sensor.lens.width * rng.uniform(0.05, 0.25)

    def change(strength: float, view: View, phasor: np.ndarray) -> np.ndarray:
        size = (2 * phasor.shape[1], 2 * phasor.shape[2])
        down, along = (np.minimum(np.arange(n), n - np.arange(n)) for n in size)
        kernel = np.exp(-np.hypot(down[:, None], along) / length)
        kernel /= kernel.sum()
        wide = np.fft.ifft2(np.fft.fft2(phasor, size) * np.fft.fft2(kernel))
        return phasor + strength * wide[:, : phasor.shape[1], : phasor.shape[2]]

    return change


@form("stray_light", "light", 0.05, target="checkerboard")
def ghost(rng: Random, world: World) -> Change:
    """A reflection between lens and sensor: the image upside down, smaller and out of focus."""
    size = rng.uniform(0.5, 1.0)
    column, row = world.pixel_position
    high, wide = column.shape
    rows = np.clip(((1 - row / size) / 2 * (high - 1)).round().astype(int), 0, high - 1)
    columns = np.clip(((1 - column / size) / 2 * (wide - 1)).round().astype(int), 0, wide - 1)
    there = (np.abs(row) <= size) & (np.abs(column) <= size)

    def change(strength: float, view: View, phasor: np.ndarray) -> np.ndarray:
        mirrored = np.where(there, phasor[:, rows, columns], 0)
        blurred = sum(np.roll(mirrored, (i, j), (1, 2)) for i in (-1, 0, 1) for j in (-1, 0, 1)) / 9
        return phasor + strength * blurred

    return change


@form("stray_light", "light", 0.05, target="checkerboard")
def veil(rng: Random, world: World) -> Change:
    """A dirty cover glass: every pixel sees a share of the mean of the image."""
    return lambda strength, _, phasor: phasor + strength * phasor.mean((1, 2), keepdims=True)


@form("mixed_pixels", "light", textbook=True, scaled=False, scene="board", mask=UNERODED)
def defocus(rng: Random, world: World) -> Change:
    """Out of focus: the footprint is a round blur that reaches into the neighbours'."""
    return _footprint(world, rng.uniform(0.4, 0.9) * rng.standard_normal((SUBPIXELS, 2)))


@form("mixed_pixels", "light", scaled=False, scene="board", mask=UNERODED)
def aperture(rng: Random, world: World) -> Change:
    """Every pixel sees a square footprint, at a board's edge half of it behind the board."""
    grid = (np.arange(4) - 1.5) / 4
    return _footprint(world, np.stack(np.meshgrid(grid, grid), axis=-1).reshape(-1, 2))


def _footprint(world: World, offsets: Array) -> Change:
    """The mean of the phasors at offsets (K, 2), in pixels times the strength."""
    centre = np.stack(world.sensor.lens.slopes())
    pitch = 1 / np.array(world.sensor.lens.focal)

    def change(strength: float, view: View, phasor: np.ndarray) -> np.ndarray:
        turn, total = 4j * np.pi * view.frequency / SPEED_OF_LIGHT, np.zeros_like(phasor)
        edge = view.path - view.distance  # base errors, as at the pixel's middle
        for offset in offsets:
            near = see(world, slopes=centre + (strength * pitch * offset)[:, None, None])
            total += near.amplitude * np.exp(turn * (near.distance + edge))
        share = np.where(view.on_target, view.amplitude / np.abs(phasor), 1.0)
        return total / len(offsets) / share

    return change


@form("mixed_pixels", "light", 0.05, scene="board")
def perforated(rng: Random, world: World) -> Change:
    """A perforated sheet: through its holes a pixel sees the wall behind."""
    pitch = world.surface.square * rng.uniform(0.7, 1.4)

    def change(strength: float, view: View, phasor: np.ndarray) -> np.ndarray:
        behind = world.surface.behind / view.cosine
        holes = np.cos(np.pi * view.x / pitch) ** 2 * np.cos(np.pi * view.y / pitch) ** 2
        share = np.minimum(strength * holes, 0.9) * view.on_target
        turn = np.exp(4j * np.pi * view.frequency / SPEED_OF_LIGHT * behind)
        weaker = (view.distance / (view.distance + behind)) ** 2
        return phasor * (1 - share + share * weaker * turn)

    return change
