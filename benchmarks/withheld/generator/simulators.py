"""The worlds of a simulator that stands beside the camera's: its hand-eye, errors and poses."""

from dataclasses import replace

import numpy as np

from benchmarks.withheld.generator.base_errors import BaseErrors
from benchmarks.withheld.generator.pair_cases import PairCase
from benchmarks.withheld.generator.poses import Trajectory
from benchmarks.withheld.generator.rigid import Array, inverse, small_motions
from benchmarks.withheld.generator.world import Setup, World, draw_world

HAND_EYE_OFF = (3e-3, 3e-3)  # metres, radians, each axis: a drawing instead of a calibration


def simulator_setup(rng: np.random.Generator, setup: Setup, case: PairCase) -> Setup:
    """The camera's setup with the simulator's base errors and hand-eye; what it states is exact."""
    hand_eye = setup.tool_from_camera
    if case.hand_eye_off:
        off = (rng.normal(0, size, 3) for size in HAND_EYE_OFF)
        hand_eye = hand_eye @ small_motions(*off)
    camera = replace(
        setup.camera, counts_per_electron=setup.camera.counts_per_electron / case.amplitude_gain
    )
    return replace(
        setup,
        camera=camera,
        base=kept(setup.base, case.terms),
        tool_from_camera=hand_eye,
        tool_from_camera_guess=hand_eye,
    )


def kept(base: BaseErrors, terms: tuple[str, ...]) -> BaseErrors:
    """Base errors of which only `terms` are there."""
    return BaseErrors(
        base.of_distance if "distance" in terms else np.zeros_like,
        base.of_pixel if "pixel" in terms else lambda column, row: np.zeros_like(column + row),
        base.of_amplitude if "amplitude" in terms else np.zeros_like,
    )


def at_poses_of(world: World, setup: Setup, stated_from_true: Array) -> World:
    """A simulator's world (N frames) at the camera's poses.

    The tool stands where the robot says, `stated_from_true` (N, 4, 4) away from where it is.
    """
    mounting = inverse(world.setup.tool_from_camera) @ stated_from_true @ setup.tool_from_camera
    there = world.trajectory

    def camera_at(offset: Array) -> Array:
        return there.camera_at(offset) @ mounting

    trajectory = Trajectory(there.timestamps, there.pose_id, camera_at)
    return replace(world, setup=setup, trajectory=trajectory)


def at_other_poses(rng: np.random.Generator, world: World, setup: Setup) -> World:
    """A simulator's world at poses of its own, before the same target."""
    other = draw_world(rng, setup, world.design)
    target = replace(world.target, checkerboard=other.target.checkerboard)
    return replace(other, target=target)
