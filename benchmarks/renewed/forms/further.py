"""Forms that the renewed check lacks: those of the regression set alone."""

from dataclasses import replace

import numpy as np

from benchmarks.renewed.forms.light import rendered
from benchmarks.renewed.geometry import SPEED_OF_LIGHT, Array, Random, small_motions
from benchmarks.renewed.signal_chain import Change, View, adding, form
from benchmarks.renewed.world import World

CAMERA_WEIGHT = np.array([0.0, 0.0, -1.0])  # direction in the world


@form("multipath", "light", 0.1)
def above_floor(rng: Random, world: World) -> Change:
    """Light by way of a floor, mirrored there; its weight falls with the height above the floor."""
    middle = float(np.sqrt(world.design.near * world.design.far))
    floor, fall = -middle * rng.uniform(0.3, 0.8), middle * rng.uniform(0.15, 0.5)

    def change(strength: float, view: View, phasor: np.ndarray) -> np.ndarray:
        mirrored = view.origin * [1.0, -1.0, 1.0] + [0.0, 2 * floor, 0.0]
        x, y, z = (mirrored[:, i, None, None] for i in range(3))
        longer = (np.sqrt((view.x - x) ** 2 + (view.y - y) ** 2 + z**2) - view.distance) / 2
        turn = np.exp(4j * np.pi * view.frequency / SPEED_OF_LIGHT * longer)
        weight = np.exp(-np.maximum(view.y - floor, 0.0) / fall)
        return phasor * (1 + strength * weight * turn)

    return change


@form("multipath", "light", scaled=False, scene="closed", moving=False)
def bright_room(rng: Random, world: World) -> Change:
    """All bounces in a closed room whose walls are as bright as the target."""
    return rendered(world, replace(world.surface.room, albedo=rng.uniform(0.6, 0.85)))


@form("wiggling", "path", 0.01)
def wiggle_of_dark(rng: Random, world: World) -> Change:
    """Wiggling that fades as pixels get brighter: distance times amplitude."""
    start, fade = rng.uniform(0, 2 * np.pi), rng.uniform(0.15, 0.5)
    turn = 16 * np.pi * world.sensor.frequencies[-1] / SPEED_OF_LIGHT

    def wave(view: View) -> Array:
        dark = np.exp(-view.amplitude / view.bright / fade)
        return dark * np.sin(turn * view.distance + start)

    return adding(wave)


@form("robot_kinematics", "poses", 0.01)
def sagging_bracket(rng: Random, world: World) -> Change:
    """The camera's bracket bends under its weight: its sag turns with the roll of the tool."""
    stiff = rng.uniform(0.5, 1.5, 2)

    def change(strength: float, view: View, world_from_tool: Array) -> Array:
        down = np.einsum("nji,j->ni", world_from_tool[:, :3, :3], CAMERA_WEIGHT)
        zero = np.zeros(len(down))
        bend = np.stack([-stiff[0] * down[:, 1], stiff[1] * down[:, 0], zero], -1)
        return world_from_tool @ small_motions(0.1 * strength * down, strength * bend)

    return change


@form("distance", "path", 0.005)
def knee(rng: Random, world: World) -> Change:
    """The error has a knee in distance."""
    at = rng.uniform(0.3, 0.7) * (world.design.near + world.design.far)
    return adding(lambda view: np.abs(view.distance - at))


@form("pixel", "path", 0.005)
def trefoil(rng: Random, world: World) -> Change:
    """The error over the image is a trefoil."""
    column, row = world.pixel_position
    wave = np.hypot(column, row) ** 3 * np.cos(3 * np.arctan2(row, column) + rng.uniform(0, 6))
    return adding(wave)


@form("amplitude", "path", 0.0005)
def inverse_amplitude(rng: Random, world: World) -> Change:
    """The error goes with one over the amplitude."""
    return adding(lambda view: np.minimum(view.bright / view.amplitude, 50.0))
