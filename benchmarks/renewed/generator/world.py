"""Everything of a recording that is drawn before light enters the camera."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from benchmarks.renewed.generator import ranges
from benchmarks.renewed.generator.conditions import Conditions, draw_conditions
from benchmarks.renewed.generator.design import Design, draw_design
from benchmarks.renewed.generator.sensor import Sensor, draw_sensor
from benchmarks.renewed.generator.stations import Way, draw_way
from benchmarks.renewed.generator.surface import Surface, draw_room, draw_surface
from benchmarks.withheld.generator.rigid import Array, inverse, small_motions


@dataclass(frozen=True)
class World:
    """A camera on a robot before a target."""

    sensor: Sensor
    design: Design
    way: Way
    conditions: Conditions
    surface: Surface
    tool_from_camera: Array  # (4, 4)
    guess: Array  # (4, 4) of it, as recording.yaml tells
    world_from_target: Array  # (4, 4)
    seed: int  # of what is rendered

    @property
    def frames(self) -> int:
        """Number of frames."""
        return self.design.frames

    @cached_property
    def pixel_position(self) -> tuple[Array, Array]:
        """Column and row (H, W), each from -1 to 1."""
        lens = self.sensor.lens
        column, row = np.meshgrid(np.linspace(-1, 1, lens.width), np.linspace(-1, 1, lens.height))
        return column, row

    def world_from_tool(self, late: Array | float = 0.0) -> Array:
        """True poses (N, 4, 4) some seconds after each frame's stamp."""
        there = self.way.camera_at(np.broadcast_to(np.asarray(late, float), (self.frames,)))
        return self.world_from_target @ there @ inverse(self.tool_from_camera)


def draw_world(rng: np.random.Generator, wanted: Mapping[str, Any] | None = None) -> World:
    """Draw a camera, a robot, a target and a design; `wanted` fixes some of the design."""
    near = ranges.NEAR_M.draw(rng)
    far = min(near * ranges.FARTHEST_TIMES.draw(rng), ranges.FARTHEST_M)
    sensor = draw_sensor(rng, near, far)
    design = draw_design(rng, sensor.lens.width * sensor.lens.height, near, far, wanted or {})
    room = draw_room(rng, design)
    way = draw_way(rng, design, room)
    arm = np.array([0.0, 0.0, 0.09]) + rng.normal(0, 0.06, 3)
    mounting = small_motions(arm, rng.normal(0, [0.2, 0.2, 1.5]))
    metres, radians = ranges.GUESS
    miss = small_motions(rng.normal(0, metres, 3), rng.normal(0, radians, 3))
    ahead = far + rng.uniform(0.25, 0.6)
    place = small_motions(np.array([ahead, *rng.uniform(-0.3, 0.3, 2)]), np.zeros(3))
    upright = small_motions(np.zeros(3), np.array([0.0, -np.pi / 2, 0.0]))
    turn = small_motions(np.zeros(3), rng.normal(0, [0.03, 0.03, 0.5]))
    return World(
        sensor=sensor,
        design=design,
        way=way,
        conditions=draw_conditions(rng, design, way),
        surface=draw_surface(rng, design, room, way.pose_id),
        tool_from_camera=mounting,
        guess=mounting @ miss,
        world_from_target=turn @ place @ upright,
        seed=int(rng.integers(2**31)),
    )


def session_again(rng: np.random.Generator, world: World) -> World:
    """Another session of the same camera, robot, target and design."""
    room = world.surface.room
    way = draw_way(rng, world.design, room)
    kinds = draw_surface(rng, world.design, room, way.pose_id).kind
    return replace(
        world,
        way=way,
        conditions=draw_conditions(rng, world.design, way),
        surface=replace(world.surface, kind=kinds),
        seed=int(rng.integers(2**31)),
    )
