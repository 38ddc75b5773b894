"""The frames of a simulated recording before they are simulated: poses, targets, conditions."""

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from tofcorr.errors import ConfigError
from tofcorr.geometry import se3
from tofcorr.geometry.planes import plane_in_frame, ray_plane_distance
from tofcorr.geometry.rays import ray_directions
from tofcorr.simulation.camera_mount import perturbed
from tofcorr.simulation.drawn_conditions import draw_conditions, draw_timestamps
from tofcorr.simulation.hooks import FrameConditions
from tofcorr.simulation.options import SimulatorOptions
from tofcorr.simulation.robot import (
    FillsImage,
    draw_camera_path,
    draw_camera_poses,
    draw_twist,
)
from tofcorr.simulation.scene import world_from_plane


@dataclass(frozen=True, kw_only=True)
class PlannedFrame:
    """One frame before it is simulated.

    Attributes:
        target: Name of the target.
        pose_id: Frames with the same id are taken without moving; None if the robot never stops.
        conditions: All conditions, recorded or not.
        world_from_tool_recorded: What the robot reports, shape (4, 4).
        world_from_tool: The true pose, shape (4, 4).
        tool_twist: Velocity in the tool's own frame, translation first, shape (6,), m/s and rad/s.
    """

    target: str
    pose_id: int | None
    conditions: FrameConditions
    world_from_tool_recorded: Tensor
    world_from_tool: Tensor
    tool_twist: Tensor


@dataclass(frozen=True, kw_only=True)
class Plan:
    """All frames of a recording before they are simulated, and its hand-eye guess (4, 4)."""

    frames: tuple[PlannedFrame, ...]
    tool_from_camera_guess: Tensor


def draw_plan(
    options: SimulatorOptions, generator: torch.Generator, *, num_frames: int | None = None
) -> Plan:
    """Draw poses, targets and conditions of a recording.

    Args:
        options: Camera, scene, robot.
        generator: Source of randomness.
        num_frames: Only the first frames; None: all.

    Raises:
        ConfigError: No pose was found where the wall fills the image, or fewer frames are
            planned than asked for.
    """
    targets = [shot.target for shot in options.shots for _ in range(shot.poses)]
    order = torch.randperm(len(targets), generator=generator).tolist()
    targets = [targets[place] for place in order]
    plan = _plan_path if options.robot.motion == "continuous" else _plan_stops
    frames = plan(options, targets, generator)
    if num_frames is not None and num_frames > len(frames):
        raise ConfigError(
            f"{num_frames} frames are asked for, but the options plan {len(frames)}; "
            "raise 'poses' under 'shots'."
        )
    frames = frames[:num_frames]
    guess = torch.eye(4, dtype=torch.float64)
    if options.hand_eye.guess is not None:
        truth = options.hand_eye.tool_from_camera()
        guess = perturbed(truth, options.hand_eye.guess, generator)
    return Plan(frames=tuple(frames), tool_from_camera_guess=guess)


def _plan_stops(
    options: SimulatorOptions, targets: list[str], generator: torch.Generator
) -> list[PlannedFrame]:
    robot = options.robot
    poses = draw_camera_poses(robot, len(targets), _fills_image(options), generator)
    if robot.order == "by_distance":
        poses.sort(key=lambda pose: pose.distance)
    repeats = [
        robot.repeat_frames if pose < robot.repeat_poses else 1 for pose in range(len(poses))
    ]
    pose_ids = [pose for pose, count in enumerate(repeats) for _ in range(count)]
    jitter = options.conditions.interval_jitter
    timestamps = draw_timestamps(options.conditions, len(pose_ids), jitter, generator)
    conditions = draw_conditions(options.conditions, timestamps, pose_ids, generator)
    commanded = [_world_from_tool(options, pose.plane_from_camera) for pose in poses]
    reached = [pose @ _robot_noise(options, generator) for pose in commanded]
    at_rest = torch.zeros(6, dtype=torch.float64)
    return [
        PlannedFrame(
            target=targets[pose],
            pose_id=pose,
            conditions=frame_conditions,
            world_from_tool_recorded=commanded[pose],
            world_from_tool=reached[pose],
            tool_twist=at_rest,
        )
        for pose, frame_conditions in zip(pose_ids, conditions, strict=True)
    ]


def _plan_path(
    options: SimulatorOptions, targets: list[str], generator: torch.Generator
) -> list[PlannedFrame]:
    timestamps = draw_timestamps(options.conditions, len(targets), 0.0, generator)
    poses, camera_twists = draw_camera_path(
        options.robot, timestamps, _fills_image(options), generator
    )
    frames = list(range(len(targets)))
    conditions = draw_conditions(options.conditions, timestamps, frames, generator)
    tool_from_camera = options.hand_eye.tool_from_camera()
    planned = []
    for frame, frame_conditions in zip(frames, conditions, strict=True):
        commanded = _world_from_tool(options, poses[frame].plane_from_camera)
        planned.append(
            PlannedFrame(
                target=targets[frame],
                pose_id=None,
                conditions=frame_conditions,
                world_from_tool_recorded=commanded,
                world_from_tool=commanded @ _robot_noise(options, generator),
                tool_twist=_adjoint(tool_from_camera) @ camera_twists[frame],
            )
        )
    return planned


def _world_from_tool(options: SimulatorOptions, plane_from_camera: Tensor) -> Tensor:
    world_from_camera = world_from_plane(*options.scene.plane.tensors()) @ plane_from_camera
    return world_from_camera @ se3.inverse(options.hand_eye.tool_from_camera())


def _robot_noise(options: SimulatorOptions, generator: torch.Generator) -> Tensor:
    robot = options.robot
    return se3.exp(
        draw_twist(robot.repeatability_mm * 1e-3, robot.repeatability_mrad * 1e-3, generator)
    )


def _adjoint(transform: Tensor) -> Tensor:
    """Return the (6, 6) matrix that carries a twist, translation first, to the target frame."""
    rotation, (x, y, z) = transform[:3, :3], transform[:3, 3].tolist()
    cross = transform.new_tensor([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    top = torch.cat([rotation, cross @ rotation], dim=1)
    return torch.cat([top, torch.cat([torch.zeros_like(rotation), rotation], dim=1)])


def _fills_image(options: SimulatorOptions) -> FillsImage:
    """Return a function that says whether every pixel sees the wall, near and frontal enough."""
    rays = ray_directions(options.camera.intrinsics())
    # The wall is flat: if the rays at the image border satisfy the limits, so do all others.
    border = torch.cat(
        [rays[:1], rays[-1:], rays[:, :1].transpose(0, 1), rays[:, -1:].transpose(0, 1)], 1
    )
    steepest = math.cos(math.radians(options.robot.steepest_incidence_deg))
    farthest = options.robot.farthest_pixel_m or math.inf
    wall = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)

    def fills_image(plane_from_camera: Tensor) -> bool:
        normal, offset = plane_in_frame(wall, wall.new_zeros(()), plane_from_camera)
        distance = ray_plane_distance(border, normal, offset)
        frontal = -(border @ normal) >= steepest
        return bool((frontal & (distance <= farthest)).all())

    return fills_image
