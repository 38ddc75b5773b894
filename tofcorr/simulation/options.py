"""All options of the simulator: what `configs/simulate/*.yaml` holds."""

from typing import Annotated, Any, ClassVar

from pydantic import ConfigDict, Field, field_validator

from tofcorr.data.recording import CameraSection, DepthKind
from tofcorr.geometry.camera import CameraIntrinsics
from tofcorr.options import Options
from tofcorr.simulation.numbers import Count, PositiveNumber
from tofcorr.simulation.robot import CameraMountOptions, ConditionOptions, RobotOptions
from tofcorr.simulation.scene import SceneOptions
from tofcorr.simulation.signal import DelayOptions, Harmonic, LightOptions, ReadoutOptions


class CameraOptions(CameraSection):
    """The camera intrinsics; keys as in `recording.yaml`."""

    model_config = ConfigDict(extra="forbid")

    @classmethod
    def of(cls, camera: CameraIntrinsics) -> "CameraOptions":
        """Return the options of a camera."""
        return cls(**camera.section())


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
