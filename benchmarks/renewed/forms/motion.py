"""Forms of what is wrong with the robot, with clocks, and with frames that take time."""

import numpy as np

from benchmarks.renewed.geometry import (
    SPEED_OF_LIGHT,
    Array,
    Random,
    directions,
    inverse,
    small_motions,
)
from benchmarks.renewed.signal_chain import Change, View, form
from benchmarks.renewed.world import NOMINAL_US, World

STEP_S = 0.01  # for speeds by differences


@form("robot_kinematics", "poses", 0.005, textbook=True)
def scale(rng: Random, world: World) -> Change:
    """Links longer than the controller believes: positions are scaled about the base."""
    sign = rng.choice([-1.0, 1.0])

    def change(strength: float, view: View, poses: Array) -> Array:
        moved = np.array(poses)
        moved[:, :3, 3] *= 1 + sign * strength
        return moved

    return change


@form("robot_kinematics", "poses", 0.01)
def elbow(rng: Random, world: World) -> Change:
    """The elbow's encoder is eccentric: all behind it turns about it, with the elbow's angle."""
    length, start = 0.62 * _reach(world), rng.uniform(0, 2 * np.pi)

    def change(strength: float, view: View, poses: Array) -> Array:
        hand = poses[:, :3, 3]
        far = np.linalg.norm(hand, axis=1)
        side = np.cross(hand, [0.0, 0.0, 1.0])
        side /= np.linalg.norm(side, axis=1, keepdims=True)
        half = np.arccos(np.clip(far / (2 * length), -1, 1))
        up = np.cross(side, hand / far[:, None])
        joint = hand / 2 + up * (length * np.sin(half))[:, None]
        angle = strength * np.sin(2 * half + start)
        turn = small_motions(np.zeros_like(hand), side * angle[:, None])
        there = small_motions(joint, np.zeros_like(hand))
        return there @ turn @ inverse(there) @ poses

    return change


@form("robot_kinematics", "poses", 0.005)
def backlash(rng: Random, world: World) -> Change:
    """Gears with play: the arm stays behind, on the side from which it came."""
    size = rng.normal(0, 1, 3)

    def change(strength: float, view: View, poses: Array) -> Array:
        way = np.diff(poses[:, :3, 3], axis=0, prepend=poses[:1, :3, 3])
        side = np.sign(way)
        for i in range(1, len(side)):  # a repeat keeps the side of its approach
            side[i] = np.where(side[i] == 0, side[i - 1], side[i])
        reach = poses[:, :3, 3] / _reach(world)
        lean = strength * side * size
        moved = small_motions(np.zeros_like(lean), lean * 0.5 / _reach(world)) @ poses
        moved[:, :3, 3] += lean * (0.5 + np.abs(reach))
        return moved

    return change


def _reach(world: World) -> float:
    return float(np.linalg.norm(world.world_from_tool()[:, :3, 3], axis=1).max())


@form("timestamp_offset", "poses", 0.02, textbook=True, moving=True)
def offset_clock(rng: Random, world: World) -> Change:
    """The camera's clock is late by a constant."""
    sign = rng.choice([-1.0, 1.0])
    return lambda strength, view, poses: world.world_from_tool(sign * strength)


@form("timestamp_offset", "poses", 0.02, moving=True)
def running_clock(rng: Random, world: World) -> Change:
    """The camera's clock runs fast or slow: an offset that grows."""
    share = world.way.seconds / world.way.seconds[-1] * rng.choice([-1.0, 1.0])
    return lambda strength, view, poses: world.world_from_tool(strength * share)


@form("timestamp_offset", "poses", 0.02, moving=True, exposure="random")
def start_of_exposure(rng: Random, world: World) -> Change:
    """Stamps tell when a frame was asked for, which is the earlier the longer it is exposed."""
    share = world.conditions.exposure / NOMINAL_US
    return lambda strength, view, poses: world.world_from_tool(strength * share)


def speed(view: View) -> Array:
    """Metres a second (N, H, W) at which every ray grows longer."""
    world, result = view.world, []
    rays = directions(*world.sensor.lens.slopes())
    for late in (-STEP_S, STEP_S):
        there = world.way.camera_at(np.full(world.frames, late))
        slope = np.einsum("nj,hwj->nhw", there[:, 2, :3], rays)
        result.append(-there[:, 2, 3, None, None] / np.minimum(slope, -0.05))
    return (result[1] - result[0]) / (2 * STEP_S)


@form("motion", "taps", 0.01, textbook=True, moving=True)
def one_by_one(rng: Random, world: World) -> Change:
    """The four samples are taken one after the other."""
    return _at_times(np.array([-1.5, -0.5, 0.5, 1.5]))


@form("motion", "taps", 0.02, moving=True)
def in_pairs(rng: Random, world: World) -> Change:
    """Two exposures, each for two opposite samples."""
    return _at_times(np.array([-0.5, 0.5, -0.5, 0.5]))


def _at_times(times: Array) -> Change:
    def change(strength: float, view: View, taps: Array) -> Array:
        mean = taps.mean(0)
        phasor = (taps[0] - taps[2]) / 2 + 0.5j * (taps[3] - taps[1])
        turn = 4 * np.pi * view.frequency / SPEED_OF_LIGHT * speed(view) * strength
        stepped = (phasor * np.exp(0.5j * np.pi * i) for i in range(4))
        turned = (one * np.exp(1j * turn * t) for one, t in zip(stepped, times, strict=True))
        return mean + np.stack([np.real(one) for one in turned])

    return change


@form("motion", "path", 0.05, moving=True)
def rolling(rng: Random, world: World) -> Change:
    """Rows are read one after the other."""
    rows = np.linspace(-0.5, 0.5, world.sensor.lens.height)[:, None] * rng.choice([-1.0, 1.0])
    return lambda strength, view, path: path + strength * rows * speed(view)
