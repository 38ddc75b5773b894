"""All options of the simulator: what `configs/simulate/*.yaml` holds."""

import math
from importlib.resources import files
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal, Self

import torch
from pydantic import ConfigDict, Field, field_validator, model_validator
from torch import Tensor

from tofcorr.data.recording import CameraSection, DepthKind
from tofcorr.data.table import COLUMN_OF
from tofcorr.geometry import se3
from tofcorr.geometry.arm import Arm
from tofcorr.geometry.camera import FrameNames
from tofcorr.options import (
    Count,
    NonNegativeNumber,
    Number,
    Options,
    PositiveNumber,
    Range,
    Vector3,
    among,
)
from tofcorr.simulation.scene import SceneOptions
from tofcorr.simulation.signal import DelayOptions, Harmonic, LightOptions, ReadoutOptions


class CameraOptions(CameraSection):
    """The camera intrinsics; keys as in `recording.yaml`."""

    model_config = ConfigDict(extra="forbid")


class SensorOptions(Options):
    """Light source, pixel and converter.

    Attributes:
        modulation_frequency_hz: Nominal; `twin` uses that of the recording if it is known.
        harmonics: Overtones of the correlation function.
        light: Light source, lens and sensitivity.
        delays: Delays of the signal.
        readout: Noise and converter.
    """

    modulation_frequency_hz: PositiveNumber = 20.0e6
    harmonics: tuple[Harmonic, ...] = ()
    light: LightOptions = LightOptions()
    delays: DelayOptions = DelayOptions()
    readout: ReadoutOptions = ReadoutOptions()

    @field_validator("harmonics")
    @classmethod
    def _each_once(cls, harmonics: tuple[Harmonic, ...]) -> tuple[Harmonic, ...]:
        orders = [harmonic.order for harmonic in harmonics]
        if len(set(orders)) < len(orders):
            raise ValueError(f"each order may appear once only, got {orders}")
        return harmonics


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
        twist = torch.tensor((0.0, 0.0, 0.0, *self.rotation_deg), dtype=torch.float64)
        translation = torch.tensor(self.translation_mm, dtype=torch.float64) / 1000
        return se3.assemble(se3.exp(torch.deg2rad(twist))[:3, :3], translation)


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
    recorded: tuple[Annotated[str, among(COLUMN_OF, "optional column")], ...] = tuple(COLUMN_OF)


def _filled(values: tuple[float, ...], number: int) -> Tensor:
    return torch.tensor([*values, *[0.0] * number][:number], dtype=torch.float64)


class ArmOptions(Options):
    """The robot's arm: its joint angles are recorded, and its joints may have offsets.

    The world is the frame of its base. Recorded poses are those of its description at the recorded
    angles; the true ones have the offsets, and links of other lengths.

    Attributes:
        urdf: File of its description; null: an arm of six axes with a reach of 0.85 m.
        offsets_deg: What is added to each recorded angle, from the base on (of a sliding joint,
            as many 17.5 mm); those that are not given are zero.
        lengths_mm: What each link is longer, from the base on: a length is a number of a joint's
            `origin` that is not zero; those that are not given are zero.
        home_deg: Angles from which each pose is looked for; those that are not given are zero.
    """

    urdf: str | None = None
    offsets_deg: tuple[Number, ...] = ()
    lengths_mm: tuple[Number, ...] = ()
    home_deg: tuple[Number, ...] = (0.0, -40.0, 100.0, -60.0, 20.0, 0.0)

    @property
    def file(self) -> Path:
        """The arm's description."""
        shipped = files("tofcorr.simulation").joinpath("arm.urdf")
        return Path(str(shipped) if self.urdf is None else self.urdf)

    def arm(self, tolerance_mm: float = math.inf) -> Arm:
        """Return the chain of joints, and of lengths above a tolerance."""
        return Arm.read(self.file, tolerance=tolerance_mm / 1000)

    def radians(self, degrees: tuple[float, ...], number: int) -> Tensor:
        """Return angles of all joints, shape (J,), radians."""
        return torch.deg2rad(_filled(degrees, number))

    def exact(self, angles: Tensor) -> Tensor:
        """Return the true base_from_tip at recorded angles (N, J), shape (N, 4, 4)."""
        long = self.arm(0.0)
        lengths = _filled(self.lengths_mm, int(long.is_length.sum())) / 1000
        offsets = self.radians(self.offsets_deg, angles.shape[1])
        return long.poses(long.placed(angles + offsets, lengths))


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
        arm: The arm that carries the camera, for stop_and_go; null: poses alone are recorded.
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
    arm: ArmOptions | None = None

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        low, high = self.distance_m
        if high < low:
            raise ValueError(f"distance_m: the smallest, {low:g}, exceeds the largest, {high:g}")
        if self.motion == "continuous" and (self.repeat_poses or self.order != "random"):
            raise ValueError("continuous motion allows neither repeat_poses nor another order")
        if self.motion == "continuous" and self.arm is not None:
            raise ValueError("an arm moves in stop_and_go only")
        return self


class ShotOptions(Options):
    """A number of poses in front of one target."""

    target: str = "white"
    poses: Annotated[int, Field(ge=1)] = 30


class SimulatorOptions(Options):
    """A simulated camera, and the recording to be made with it.

    Attributes:
        seed: Determines all random draws.
        camera: The camera intrinsics.
        depth_kind: What the depth images contain.
        write_raw: Whether the recording contains the samples A0..A3.
        shots: Targets and numbers of poses.
        scene: Appearance of the targets and plane of the wall.
        sensor: Light source, pixel and converter.
        robot: Poses of the camera.
        hand_eye: Where the camera is mounted on the robot's tool.
        conditions: Time, exposure, temperature, background light.
        effects: Effects beyond the plain sensor, each with its `name` and parameters.
        frames: What the robot calls its coordinate frames; names the camera of several.
        robot_of: Folder of a simulated recording whose robot carries this camera too: stops, their
            errors, targets and conditions are that recording's; `shots`, `robot` and `conditions`
            are not used. null: the camera has a robot of its own.
    """

    config_folder: ClassVar[str] = "simulate"

    seed: Count = 1
    camera: CameraOptions
    depth_kind: DepthKind = "radial"
    write_raw: bool = False
    shots: Annotated[tuple[ShotOptions, ...], Field(min_length=1)] = (ShotOptions(),)
    scene: SceneOptions = SceneOptions()
    sensor: SensorOptions = SensorOptions()
    robot: RobotOptions = RobotOptions()
    hand_eye: CameraMountOptions = CameraMountOptions()
    conditions: ConditionOptions = ConditionOptions()
    effects: tuple[dict[str, Any], ...] = ()
    frames: FrameNames = FrameNames()
    robot_of: str | None = None
