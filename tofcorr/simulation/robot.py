"""The robot of a simulated recording: its camera mount, conditions, poses and paths."""

import math
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Annotated, Literal, NamedTuple, Self

import numpy as np
import torch
from pydantic import AfterValidator, Field, model_validator
from torch import Tensor

from tofcorr.data.table import COLUMN_OF
from tofcorr.errors import ConfigError
from tofcorr.geometry import se3
from tofcorr.options import Options
from tofcorr.simulation.hooks import FrameConditions
from tofcorr.simulation.numbers import (
    Count,
    NonNegativeNumber,
    Number,
    PositiveNumber,
    Range,
    Vector3,
)


class MountGuessOptions(Options):
    """Distance of the recorded guess of the hand-eye transform from the true one."""

    translation_mm: NonNegativeNumber = 30.0
    rotation_deg: NonNegativeNumber = 5.0


class CameraMountOptions(Options):
    """The true hand-eye transform, and the guess of it in the recording.

    Attributes:
        translation_mm: Position of the camera in the tool frame.
        rotation_deg: Rotation vector: its direction is the axis, its length the angle.
        guess: Distance of the recorded guess from the truth, in a random direction; null: the guess
            is the identity.
    """

    translation_mm: Vector3 = (50.0, -20.0, 120.0)
    rotation_deg: Vector3 = (1.5, -2.0, 88.0)
    guess: MountGuessOptions | None = None

    def tool_from_camera(self) -> Tensor:
        """Return the true transform, shape (4, 4)."""
        rotation = torch.deg2rad(torch.tensor(self.rotation_deg, dtype=torch.float64))
        turned = se3.exp(torch.cat([torch.zeros(3, dtype=torch.float64), rotation]))
        translation = torch.tensor(self.translation_mm, dtype=torch.float64) * 1e-3
        return se3.assemble(turned[:3, :3], translation)

    @classmethod
    def from_matrix(cls, tool_from_camera: Tensor) -> Self:
        """Return the options whose truth is this transform (4, 4)."""
        rotation = se3.log(tool_from_camera.detach())[3:]
        return cls(
            translation_mm=tuple((tool_from_camera[:3, 3].detach() * 1e3).tolist()),
            rotation_deg=tuple(torch.rad2deg(rotation).tolist()),
        )


def perturbed(transform: Tensor, guess: MountGuessOptions, generator: torch.Generator) -> Tensor:
    """Return a transform that differs from `transform` by `guess`, in a random direction."""
    direction = torch.nn.functional.normalize(
        torch.randn(2, 3, generator=generator, dtype=torch.float64), dim=-1
    )
    zero = torch.zeros(3, dtype=torch.float64)
    turn = se3.exp(torch.cat([zero, direction[1] * math.radians(guess.rotation_deg)]))
    shift = transform[:3, 3] + direction[0] * guess.translation_mm * 1e-3
    return se3.assemble(transform[:3, :3] @ turn[:3, :3], shift)


# The conditions of simulated frames: time, exposure, temperatures and background light.


_RECORDABLE = tuple(COLUMN_OF)


def _recordable(name: str) -> str:
    if name not in _RECORDABLE:
        raise ValueError(f"expected one of {', '.join(_RECORDABLE)}")
    return name


Recorded = Annotated[str, AfterValidator(_recordable)]


class ConditionOptions(Options):
    """How the conditions of the frames are drawn.

    Attributes:
        frame_interval_s: Mean time from frame to frame.
        interval_jitter: Largest deviation of an interval from the mean, as a share of it (uniformly
            distributed); not used in continuous motion.
        integration_time_us: One is drawn for each pose.
        ambient_counts: Background light in counts per tap at the first integration time, drawn
            for each pose between these bounds.
        room_temperature_c: Of the room at the first frame.
        room_drift_c: Amplitude of the room's temperature, which follows a sine.
        room_period_s: Period of that sine.
        body_rise_c: Temperature of the warm camera body above that of the room.
        body_time_constant_s: Time from power-on to 63 % of `body_rise_c`.
        power_on_s: Time from power-on to the first frame.
        recorded: Which optional columns the recording has; the others are left out.
    """

    frame_interval_s: PositiveNumber = 5.0
    interval_jitter: Annotated[float, Field(ge=0, lt=1)] = 0.3
    integration_time_us: Annotated[tuple[PositiveNumber, ...], Field(min_length=1)] = (500.0,)
    ambient_counts: Range = (0.0, 0.0)
    room_temperature_c: Number = 22.0
    room_drift_c: NonNegativeNumber = 0.5
    room_period_s: PositiveNumber = 1800.0
    body_rise_c: Number = 15.0
    body_time_constant_s: PositiveNumber = 600.0
    power_on_s: NonNegativeNumber = 30.0
    recorded: tuple[Recorded, ...] = _RECORDABLE


def draw_timestamps(
    options: ConditionOptions, num_frames: int, jitter: float, generator: torch.Generator
) -> list[float]:
    """Return the times of the frames in seconds, the first 0."""
    spread = 2 * torch.rand(num_frames, generator=generator, dtype=torch.float64) - 1
    intervals = options.frame_interval_s * (1 + jitter * spread)
    intervals[0] = 0.0
    return intervals.cumsum(0).tolist()


def draw_conditions(
    options: ConditionOptions,
    timestamps: list[float],
    pose_ids: list[int],
    generator: torch.Generator,
) -> list[FrameConditions]:
    """Return the conditions of each frame; frames of one pose have the same exposure and light."""
    num_poses = max(pose_ids) + 1
    levels = torch.tensor(options.integration_time_us, dtype=torch.float64)
    level = torch.randint(len(levels), (num_poses,), generator=generator)
    low, high = options.ambient_counts
    share = torch.rand(num_poses, generator=generator, dtype=torch.float64)
    exposure = levels[level] / levels[0]
    ambient = (low + (high - low) * share) * exposure
    return [
        FrameConditions(
            timestamp=time,
            integration_time=float(levels[level[pose]]) * 1e-6,
            ambient=float(ambient[pose]),
            room_temperature=_room(options, time),
            body_temperature=_room(options, time) + _rise(options, time),
        )
        for time, pose in zip(timestamps, pose_ids, strict=True)
    ]


def _room(options: ConditionOptions, time: float) -> float:
    turn = 2 * math.pi * time / options.room_period_s
    return options.room_temperature_c + options.room_drift_c * math.sin(turn)


def _rise(options: ConditionOptions, time: float) -> float:
    since_power_on = time + options.power_on_s
    return options.body_rise_c * -math.expm1(-since_power_on / options.body_time_constant_s)


# Poses and paths of the camera in front of a wall.


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
