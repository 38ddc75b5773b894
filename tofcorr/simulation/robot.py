"""A robot that moves the camera in front of a wall: its poses and paths."""

import math
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Annotated, Literal, NamedTuple, Self

import numpy as np
import torch
from pydantic import Field, model_validator
from torch import Tensor

from tofcorr.errors import ConfigError
from tofcorr.geometry import se3
from tofcorr.options import Options
from tofcorr.simulation.numbers import Count, NonNegativeNumber, PositiveNumber

if TYPE_CHECKING:
    from scipy.interpolate import CubicSpline
    from scipy.spatial.transform import RotationSpline

# Largest number of draws of a pose or a path before it is given up. Chosen by hand: all shipped
# configurations need far fewer.
_TRIES = 300


class RobotOptions(Options):
    """The poses of the camera.

    Attributes:
        distance_m: Smallest and largest distance of the wall along the optical axis.
        farthest_pixel_m: No pixel may see the wall farther away than this; null: no limit.
        steepest_incidence_deg: No pixel may see the wall at a steeper angle from its normal.
        tilt_deg: Largest tilt of the optical axis about each of two axes of the wall.
        tilt_axes: Axes to tilt about.
        roll_deg: Largest rotation about the optical axis, in both directions.
        aim_spread_m: Largest distance of the point aimed at from the wall's origin, along each axis
            of the wall.
        order: `random`, or `by_distance` as in a sweep away from the wall.
        repeat_poses: Number of poses that are recorded more than once; the first ones.
        repeat_frames: Number of frames of each of them.
        motion: `stop_and_go`, or `continuous`: frames are taken while the robot follows a smooth
            path. Poses show the velocity only if frames are at most a second apart
            (`tool_twists`).
        waypoint_every_frames: Frames between two random poses of that path.
        repeatability_mm: Standard deviation of the true from the reported position, on each axis.
        repeatability_mrad: The same for the orientation.
    """

    distance_m: tuple[PositiveNumber, PositiveNumber] = (0.5, 1.8)
    farthest_pixel_m: PositiveNumber | None = 2.0
    steepest_incidence_deg: Annotated[float, Field(gt=0, lt=90)] = 75.0
    tilt_deg: Annotated[float, Field(ge=0, lt=90)] = 30.0
    tilt_axes: Literal["both", "x", "y", "none"] = "both"
    roll_deg: Annotated[float, Field(ge=0, le=180)] = 180.0
    aim_spread_m: NonNegativeNumber = 0.3
    order: Literal["random", "by_distance"] = "random"
    repeat_poses: Count = 0
    repeat_frames: Annotated[int, Field(ge=1)] = 1
    motion: Literal["stop_and_go", "continuous"] = "stop_and_go"
    waypoint_every_frames: Annotated[int, Field(ge=2)] = 6
    repeatability_mm: NonNegativeNumber = 0.3
    repeatability_mrad: NonNegativeNumber = 0.3

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        low, high = self.distance_m
        if high < low:
            raise ValueError(
                f"distance_m: the smallest distance {low:g} exceeds the largest {high:g}"
            )
        if self.motion == "continuous" and (self.repeat_poses or self.order != "random"):
            raise ValueError(
                "continuous motion allows neither repeat_poses nor an order other than random"
            )
        return self


class Pose(NamedTuple):
    """A pose of the camera over the wall, and its distance along the optical axis in metres."""

    plane_from_camera: Tensor
    distance: float


FillsImage = Callable[[Tensor], bool]
"""From plane_from_camera (4, 4): whether every pixel sees the wall within the options' limits."""


def draw_camera_poses(
    options: RobotOptions, count: int, fills_image: FillsImage, generator: torch.Generator
) -> list[Pose]:
    """Draw poses of the camera aimed at the wall; the wall fills the image in each.

    Raises:
        ConfigError: No such pose was found.
    """
    return [_pose_that_fills(options, fills_image, generator) for _ in range(count)]


def draw_camera_path(
    options: RobotOptions,
    timestamps: Sequence[float],
    fills_image: FillsImage,
    generator: torch.Generator,
) -> tuple[list[Pose], list[Tensor]]:
    """Draw a smooth path of the camera in front of the wall.

    Returns:
        The camera's pose at each timestamp, and its twist in its own frame, each (6,), m/s and
        rad/s, translation first.

    Raises:
        ConfigError: No path was found on which the wall fills every image.
    """
    from scipy.interpolate import CubicSpline  # Slow to import; only paths and poses need them.
    from scipy.spatial.transform import Rotation, RotationSpline

    num_waypoints = max(2, math.ceil(len(timestamps) / options.waypoint_every_frames) + 1)
    times = np.asarray(timestamps, dtype=np.float64)
    duration = max(float(times[-1]), 1e-3)
    knots = np.linspace(0.0, duration, num_waypoints)
    for _ in range(_TRIES):
        waypoints = draw_camera_poses(options, num_waypoints, fills_image, generator)
        matrices = torch.stack([pose.plane_from_camera for pose in waypoints]).numpy()
        positions = CubicSpline(knots, matrices[:, :3, 3])
        rotations = RotationSpline(knots, Rotation.from_matrix(matrices[:, :3, :3]))

        def poses_at(
            when: np.ndarray,
            positions: "CubicSpline" = positions,
            rotations: "RotationSpline" = rotations,
        ) -> Tensor:
            turned = torch.from_numpy(rotations(when).as_matrix())
            return se3.assemble(turned, torch.from_numpy(positions(when)))

        path = poses_at(times)
        if all(fills_image(pose) for pose in path):
            step = 1e-4 * duration
            moved = se3.inverse(poses_at(times - step)) @ poses_at(times + step)
            twists = se3.log(moved) / (2 * step)
            return [Pose(pose, math.nan) for pose in path], list(twists)
    raise _no_pose("path")


def draw_twist(translation: float, rotation: float, generator: torch.Generator) -> Tensor:
    """Draw a twist (6,) with these standard deviations on each axis, metres and radians."""
    scale = torch.tensor([translation] * 3 + [rotation] * 3, dtype=torch.float64)
    return scale * torch.randn(6, generator=generator, dtype=torch.float64)


def tool_twists(timestamps: Tensor, world_from_tool: Tensor, longest_gap: float = 1.0) -> Tensor:
    """Estimate the velocity of the tool from the poses before and after each frame.

    Args:
        timestamps: Shape (N,), seconds, increasing.
        world_from_tool: Shape (N, 4, 4).
        longest_gap: Frames farther apart than this, seconds, are not used: the robot may have
            stopped in between. One second was set by hand.

    Returns:
        Central differences in the tool's own frame, translation first, shape (N, 6), m/s and
        rad/s; NaN (unknown) at both ends and where a neighbour is too far away.
    """
    twists = torch.full((len(timestamps), 6), torch.nan, dtype=torch.float64)
    if len(timestamps) < 3:
        return twists
    gaps = timestamps.diff()
    near = (gaps > 0) & (gaps <= longest_gap)
    moved = se3.inverse(world_from_tool[:-2]) @ world_from_tool[2:]
    elapsed = timestamps[2:] - timestamps[:-2]
    known = near[:-1] & near[1:]
    twists[1:-1][known] = se3.log(moved[known]) / elapsed[known, None]
    return twists


def _pose_that_fills(
    options: RobotOptions, fills_image: FillsImage, generator: torch.Generator
) -> Pose:
    for _ in range(_TRIES):
        pose = _draw_pose(options, generator)
        if fills_image(pose.plane_from_camera):
            return pose
    raise _no_pose("pose")


def _draw_pose(options: RobotOptions, generator: torch.Generator) -> Pose:
    from scipy.spatial.transform import Rotation

    uniform = torch.rand(6, generator=generator, dtype=torch.float64)
    centred = (2 * uniform - 1).tolist()
    low, high = options.distance_m
    distance = low + (high - low) * float(uniform[0])
    tilt = math.radians(options.tilt_deg)
    tilt_x = tilt * centred[1] if options.tilt_axes in ("both", "x") else 0.0
    tilt_y = tilt * centred[2] if options.tilt_axes in ("both", "y") else 0.0
    roll = math.radians(options.roll_deg) * centred[3]
    # The camera faces the wall: its z is against the wall's normal, its y points down.
    facing = Rotation.from_matrix(np.diag([1.0, -1.0, -1.0]))
    turned = facing * Rotation.from_euler("XYZ", [tilt_x, tilt_y, roll])
    rotation = torch.from_numpy(turned.as_matrix())
    aim = torch.tensor([centred[4], centred[5], 0.0], dtype=torch.float64) * options.aim_spread_m
    return Pose(se3.assemble(rotation, aim - distance * rotation[:, 2]), distance)


def _no_pose(what: str) -> ConfigError:
    return ConfigError(
        f"robot: no {what} found where the wall fills the image within farthest_pixel_m and "
        "steepest_incidence_deg; widen these, or reduce distance_m or tilt_deg."
    )
