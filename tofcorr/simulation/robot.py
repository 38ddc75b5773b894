"""The plan of a simulated recording: poses or a path before the wall, conditions, and targets."""

import math
from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor

from tofcorr.conditions import condition
from tofcorr.errors import ConfigError
from tofcorr.geometry import se3
from tofcorr.geometry.arm import Arm
from tofcorr.geometry.rays import plane_in_frame, ray_directions, ray_plane_distance
from tofcorr.geometry.se3 import world_from_plane
from tofcorr.simulation.effects.robot_kinematics import sides_of_approach
from tofcorr.simulation.hooks import FrameFacts, FrameState
from tofcorr.simulation.options import (
    ArmOptions,
    CameraMountOptions,
    ConditionOptions,
    RobotOptions,
    SimulatorOptions,
)

# Largest number of draws of a pose or a path before it is given up. Chosen by hand: all shipped
# configurations need far fewer.
_TRIES = 300
# How often poses are drawn for an arm before it is given up: of those before a wall at a sensible
# distance it reaches half at once.
_DRAWS = 20
FillsImage = Callable[[Tensor], bool]
"""From plane_from_camera (4, 4): whether every pixel sees the wall within the options' limits."""


def draw_plan(
    options: SimulatorOptions, generator: torch.Generator, *, num_frames: int | None = None
) -> list[FrameState]:
    """Draw poses, targets and conditions of a recording.

    Args:
        options: Camera, scene, robot.
        generator: Source of randomness.
        num_frames: Only the first frames; None: all.

    Returns:
        The frames before they are simulated: what is known of them from the start, and their poses.

    Raises:
        ConfigError: No pose was found where the wall fills the image, or fewer frames are
            planned than asked for.
    """
    robot, times = options.robot, options.conditions
    targets = [shot.target for shot in options.shots for _ in range(shot.poses)]
    targets = [targets[k] for k in torch.randperm(len(targets), generator=generator).tolist()]
    fills_image = _fills_image(options)
    if robot.motion == "continuous":
        stops = list(range(len(targets)))
        timestamps = _draw_timestamps(times, len(stops), 0.0, generator)
        poses, twists = _draw_path(robot, timestamps, fills_image, generator)
    else:
        poses = _draw_poses(robot, len(targets), fills_image, generator)
        if robot.arm is not None:
            poses = _within_reach(options, poses, fills_image, generator)
        if robot.order == "by_distance":  # Along the optical axis; the wall is z = 0.
            poses.sort(key=lambda pose: float(-pose[2, 3] / pose[2, 2]))
        repeats = [robot.repeat_frames] * robot.repeat_poses + [1] * len(poses)
        stops = [pose for pose in range(len(poses)) for _ in range(repeats[pose])]
        timestamps = _draw_timestamps(times, len(stops), times.interval_jitter, generator)
        twists = [torch.zeros(6, dtype=torch.float64)] * len(poses)
    conditions = _draw_conditions(times, timestamps, stops, generator)
    normal, offset = options.scene.plane.tensors()
    mount = options.hand_eye.tool_from_camera()
    commanded = _tools(options, poses)
    exact, angles = commanded, None
    if robot.arm is not None:
        arm = robot.arm.arm()
        angles, _ = joint_angles(arm, commanded, robot.arm)
        commanded, exact = arm.poses(angles), robot.arm.exact(angles)
    reached = [pose @ se3.exp(draw_slip(robot, generator)) for pose in exact]
    if num_frames is not None and num_frames > len(stops):
        said = f"{num_frames} frames are asked for, but the options plan {len(stops)}"
        raise ConfigError(f"{said}; raise 'poses' under 'shots'.")
    recorded = commanded[stops]
    facts = FrameFacts(
        world_from_tool=recorded,
        normal_world=normal.expand(len(stops), 3),
        offset=offset.expand(len(stops)),
        tool_twist=torch.stack([_of_tool(twist, mount) for twist in twists])[stops],
        approach=sides_of_approach(recorded),
        joint_angles=None if angles is None else angles[stops],
        **conditions,
    )
    return [
        FrameState(
            index=index,
            facts=facts.at(slice(index + 1)),
            target=targets[stop],
            world_from_tool=reached[stop],
            tool_from_camera=mount,
            pose_id=None if robot.motion == "continuous" else stop,
        )
        for index, stop in enumerate(stops[:num_frames])
    ]


def _tools(options: SimulatorOptions, poses: list[Tensor]) -> Tensor:
    """Return world_from_tool (N, 4, 4) of camera poses before the wall, plane_from_camera."""
    world = world_from_plane(*options.scene.plane.tensors())
    return world @ torch.stack(poses) @ se3.inverse(options.hand_eye.tool_from_camera())


def _within_reach(
    options: SimulatorOptions,
    poses: list[Tensor],
    fills_image: FillsImage,
    generator: torch.Generator,
) -> list[Tensor]:
    """Return as many poses, with those that the arm does not reach drawn anew."""
    robot, kept = options.robot, list[Tensor]()
    assert robot.arm is not None
    arm, number = robot.arm.arm(), len(poses)
    for _ in range(_DRAWS):
        _, reached = joint_angles(arm, _tools(options, poses), robot.arm)
        kept += [pose for pose, good in zip(poses, reached.tolist(), strict=True) if good]
        if len(kept) >= number:
            return kept[:number]
        poses = _draw_poses(robot, number, fills_image, generator)
    said = "robot.arm: it does not reach the poses before the wall"
    raise ConfigError(f"{said}; set scene.plane nearer to its base, or change distance_m.")


def joint_angles(arm: Arm, base_from_tip: Tensor, options: ArmOptions) -> tuple[Tensor, Tensor]:
    """Return joint angles (N, J) that take the tip to poses (N, 4, 4), and which it reaches (N,).

    Damped Gauss-Newton steps from the home position; limits of joints are not looked at.
    """
    angles = options.radians(options.home_deg, len(arm.names)).expand(len(base_from_tip), -1)
    damping = torch.eye(len(arm.names), dtype=torch.float64) / 1000
    for _ in range(60):  # Poses within reach take 10 to 40.
        off = se3.log(se3.inverse(arm.poses(angles)) @ base_from_tip)
        slope = se3.vee(arm.motions(angles)).mT
        normal = slope.mT @ slope + damping * off.square().sum(1)[:, None, None].clamp(max=1)
        step = torch.linalg.lstsq(normal, slope.mT @ off[..., None]).solution[..., 0]
        angles = angles + step.clamp(-0.5, 0.5)
    off = se3.log(se3.inverse(arm.poses(angles)) @ base_from_tip)
    angles = torch.remainder(angles + math.pi, 2 * math.pi) - math.pi
    return angles, off.abs().amax(dim=1) < 1e-9


def hand_eye_guess(mount: CameraMountOptions, generator: torch.Generator) -> Tensor:
    """Return the recorded guess of the hand-eye transform, shape (4, 4): see the options."""
    if mount.guess is None:
        return torch.eye(4, dtype=torch.float64)
    drawn = torch.randn(2, 3, generator=generator, dtype=torch.float64)
    direction = torch.nn.functional.normalize(drawn, dim=-1)
    zero, truth = torch.zeros(3, dtype=torch.float64), mount.tool_from_camera()
    turn = se3.exp(torch.cat([zero, direction[1] * math.radians(mount.guess.rotation_deg)]))
    shift = truth[:3, 3] + direction[0] * mount.guess.translation_mm / 1000
    return se3.assemble(truth[:3, :3] @ turn[:3, :3], shift)


def draw_slip(robot: RobotOptions, generator: torch.Generator) -> Tensor:
    """Draw the twist (6,) from a reported pose to the true one, metres and radians."""
    thousandths = [robot.repeatability_mm] * 3 + [robot.repeatability_mrad] * 3
    scale = torch.tensor(thousandths, dtype=torch.float64) / 1000
    return scale * torch.randn(6, generator=generator, dtype=torch.float64)


def _of_tool(twist: Tensor, tool_from_camera: Tensor) -> Tensor:
    """Return the camera's twist (6,), in its own frame, as that of the tool."""
    linear, angular = (tool_from_camera[:3, :3] @ part for part in (twist[:3], twist[3:]))
    return torch.cat([linear + torch.linalg.cross(tool_from_camera[:3, 3], angular), angular])


def _draw_timestamps(
    options: ConditionOptions, num_frames: int, jitter: float, generator: torch.Generator
) -> list[float]:
    """Return the times of the frames in seconds, the first 0."""
    spread = 2 * torch.rand(num_frames, generator=generator, dtype=torch.float64) - 1
    intervals = options.frame_interval_s * (1 + jitter * spread)
    intervals[0] = 0.0
    return intervals.cumsum(0).tolist()


def _draw_conditions(
    options: ConditionOptions, timestamps: list[float], stops: list[int], generator: torch.Generator
) -> dict[str, Tensor]:
    """Return the conditions of the frames, each (F,); frames of a pose share exposure and light."""
    num_poses = max(stops) + 1
    levels = torch.tensor(options.integration_time_us, dtype=torch.float64)
    level = torch.randint(len(levels), (num_poses,), generator=generator)
    low, high = options.ambient_counts
    share = torch.rand(num_poses, generator=generator, dtype=torch.float64)
    ambient = (low + (high - low) * share) * (levels[level] / levels[0])
    time = levels.new_tensor(timestamps)
    drift = torch.sin(2 * math.pi * time / options.room_period_s)
    room = options.room_temperature_c + options.room_drift_c * drift
    warmed = (time + options.power_on_s) / options.body_time_constant_s
    return {
        "timestamp": time,
        "integration_time": levels[level[stops]] * condition("integration_time").si_per_unit,
        "ambient": ambient[stops],
        "room_temperature": room,
        "body_temperature": room - options.body_rise_c * torch.expm1(-warmed),
    }


def _fills_image(options: SimulatorOptions) -> FillsImage:
    """Return a function that says whether every pixel sees the wall, near and frontal enough."""
    rays = ray_directions(options.camera.intrinsics())
    # The wall is flat: if the rays at the image border satisfy the limits, so do all others.
    sides = [rays[:1], rays[-1:], rays[:, :1].transpose(0, 1), rays[:, -1:].transpose(0, 1)]
    border = torch.cat(sides, 1)
    steepest = math.cos(math.radians(options.robot.steepest_incidence_deg))
    farthest = options.robot.farthest_pixel_m or math.inf
    wall = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)

    def fills_image(plane_from_camera: Tensor) -> bool:
        normal, offset = plane_in_frame(wall, wall.new_zeros(()), plane_from_camera)
        distance = ray_plane_distance(border, normal, offset)
        frontal = -(border @ normal) >= steepest
        return bool((frontal & (distance <= farthest)).all())

    return fills_image


def _draw_poses(
    options: RobotOptions, count: int, fills_image: FillsImage, generator: torch.Generator
) -> list[Tensor]:
    """Draw poses of the camera aimed at the wall, plane_from_camera; it fills each image."""
    poses = []
    for _ in range(count):
        tries = (_draw_pose(options, generator) for _ in range(_TRIES))
        pose = next(filter(fills_image, tries), None)
        if pose is None:
            raise _not_found("pose")
        poses.append(pose)
    return poses


def _draw_pose(options: RobotOptions, generator: torch.Generator) -> Tensor:
    from scipy.spatial.transform import Rotation  # Slow to import.

    share, *centred = torch.rand(6, generator=generator, dtype=torch.float64).tolist()
    tilt_x, tilt_y, roll, aim_x, aim_y = (2 * value - 1 for value in centred)
    low, high = options.distance_m
    tilt = math.radians(options.tilt_deg)
    about_x, about_y = (options.tilt_axes in ("both", axis) for axis in "xy")
    turns = about_x * tilt * tilt_x, about_y * tilt * tilt_y, math.radians(options.roll_deg) * roll
    # The camera faces the wall: its z is against the wall's normal, its y points down.
    facing = Rotation.from_matrix(np.diag([1.0, -1.0, -1.0]))
    rotation = torch.from_numpy((facing * Rotation.from_euler("XYZ", turns)).as_matrix())
    aim = torch.tensor([aim_x, aim_y, 0.0], dtype=torch.float64) * options.aim_spread_m
    return se3.assemble(rotation, aim - (low + (high - low) * share) * rotation[:, 2])


def _draw_path(
    options: RobotOptions,
    timestamps: list[float],
    fills_image: FillsImage,
    generator: torch.Generator,
) -> tuple[list[Tensor], list[Tensor]]:
    """Draw a smooth path of the camera in front of the wall.

    Returns:
        The camera's pose at each timestamp, plane_from_camera, and its twist in its own frame, each
        (6,), m/s and rad/s, translation first.
    """
    from scipy.interpolate import CubicSpline  # Slow to import; only paths and poses need them.
    from scipy.spatial.transform import Rotation, RotationSpline

    num_waypoints = max(2, math.ceil(len(timestamps) / options.waypoint_every_frames) + 1)
    times = np.asarray(timestamps, dtype=np.float64)
    knots = np.linspace(0.0, times[-1] or 1.0, num_waypoints)
    for _ in range(_TRIES):
        waypoints = torch.stack(_draw_poses(options, num_waypoints, fills_image, generator)).numpy()
        positions = CubicSpline(knots, waypoints[:, :3, 3])
        rotations = RotationSpline(knots, Rotation.from_matrix(waypoints[:, :3, :3]))
        turned = rotations(times)
        rotation = torch.from_numpy(turned.as_matrix())
        path = se3.assemble(rotation, torch.from_numpy(positions(times)))
        if all(fills_image(pose) for pose in path):
            # Of a spline of rotations the rate is in the moving frame already.
            rates = turned.inv().apply(positions(times, 1)), rotations(times, 1)
            return list(path), list(torch.from_numpy(np.concatenate(rates, axis=1)))
    raise _not_found("path")


def _not_found(what: str) -> ConfigError:
    said = f"robot: no {what} found where the wall fills the image within farthest_pixel_m and"
    advice = "steepest_incidence_deg; widen these, or reduce distance_m or tilt_deg."
    return ConfigError(f"{said} {advice}")
