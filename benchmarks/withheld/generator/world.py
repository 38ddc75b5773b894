"""Everything of a scene that is drawn before light enters the camera."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from benchmarks.withheld.generator.base_errors import BaseErrors, draw_base_errors
from benchmarks.withheld.generator.camera import Camera, draw_camera
from benchmarks.withheld.generator.conditions import Conditions, draw_conditions
from benchmarks.withheld.generator.poses import Design, Trajectory, draw_trajectory
from benchmarks.withheld.generator.rigid import Array, inverse, small_motions
from benchmarks.withheld.generator.target import Target, draw_target


@dataclass(frozen=True)
class Setup:
    """What stays the same when a scene is recorded again: unit, mounting, the target's place."""

    camera: Camera
    base: BaseErrors
    tool_from_camera: Array  # (4, 4)
    tool_from_camera_guess: Array  # (4, 4), what recording.yaml tells
    world_from_target: Array  # (4, 4), the target is z = 0, seen from positive z


@dataclass(frozen=True)
class World:
    """One recording session of a setup."""

    setup: Setup
    design: Design
    trajectory: Trajectory
    conditions: Conditions
    target: Target

    @property
    def camera(self) -> Camera:
        """The camera of the setup."""
        return self.setup.camera

    @property
    def frames(self) -> int:
        """Number of frames."""
        return self.design.frames

    @cached_property
    def pixel_position(self) -> tuple[Array, Array]:
        """Column and row (H, W), each from -1 to 1."""
        columns, rows = (
            np.linspace(-1, 1, self.camera.width),
            np.linspace(-1, 1, self.camera.height),
        )
        column, row = np.meshgrid(columns, rows)
        return column, row

    def world_from_tool(self, seconds: float = 0.0) -> Array:
        """True poses (N, 4, 4) a while after (or, negative, before) each frame's time stamp."""
        target_from_camera = self.trajectory.camera_at(np.full(self.frames, seconds))
        return (
            self.setup.world_from_target @ target_from_camera @ inverse(self.setup.tool_from_camera)
        )


def draw_setup(rng: np.random.Generator, wrong_base: str = "smooth") -> Setup:
    """Draw a camera on a tool before a target about 1.6 m from the robot."""
    mounting = small_motions(
        rng.normal(0, 0.07, 3) + np.array([0.0, 0.0, 0.1]), np.array([0.0, 0.0, rng.uniform(-3, 3)])
    )
    mounting = mounting @ small_motions(np.zeros(3), rng.normal(0, 0.15, 3))
    miss = small_motions(rng.normal(0, 0.008, 3), rng.normal(0, 0.02, 3))
    upright = small_motions(np.zeros(3), np.array([0.0, -np.pi / 2, 0.0]))
    turn = small_motions(np.zeros(3), np.array([0.0, 0.0, rng.uniform(-0.6, 0.6)]))
    place = small_motions(
        np.array([rng.uniform(1.4, 1.8), rng.uniform(-0.4, 0.4), rng.uniform(0.3, 0.8)]),
        np.zeros(3),
    )
    return Setup(
        camera=draw_camera(rng),
        base=draw_base_errors(rng, wrong_base),
        tool_from_camera=mounting,
        tool_from_camera_guess=mounting @ miss,
        world_from_target=turn @ place @ upright,
    )


def draw_world(rng: np.random.Generator, setup: Setup, design: Design) -> World:
    """Draw one session."""
    trajectory = draw_trajectory(rng, design)
    target = draw_target(rng, trajectory.pose_id, design.targets)
    height = trajectory.camera_at(np.zeros(design.frames))[:, 2, 3]
    brightness = np.where(target.checkerboard, 0.45, 0.82) / height**2
    return World(
        setup, design, trajectory, draw_conditions(rng, design, trajectory, brightness), target
    )
