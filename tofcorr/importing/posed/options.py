"""How images from a moving robot become a recording."""

from typing import Literal

from pydantic import Field, PositiveFloat, PositiveInt

from tofcorr.data.header import DepthKind, FrameNames
from tofcorr.importing.walls.options import WallOptions
from tofcorr.options import Options


class PosedOptions(Options):
    """How images from a moving robot become a recording.

    Attributes:
        depth_kind: What the camera's depth means: `z` along the optical axis, `radial` along the
            ray.
        time_offset_s: Added to the images' time stamps, seconds, where the clocks differ by a known
            amount.
        lag_s: How much later images are stamped than poses, seconds; `auto`: estimated and
            removed.
        pose_tolerance_s: Largest time between an image and the nearest pose, seconds.
        moving: `leave_out` uses images of stops only; `keep` uses all. Images without time stamps
            count as stops.
        images_per_stop: At most so many images of one stop, evenly spread; they measure the noise.
        walls: How walls are found.
        eye_to_hand: Whether the camera stands still and the robot carries the target.
        frames: What the robot calls its frames, as the user sees them: `world` the robot's base,
            `tool` its tool.
        modulation_frequency_hz: Of the camera; null if unknown.
        saturation_amplitude: Pixels at or above it are not used; null if unknown.
    """

    depth_kind: DepthKind = "z"
    time_offset_s: float = Field(default=0.0, allow_inf_nan=False)
    lag_s: Literal["auto"] | float = "auto"
    pose_tolerance_s: PositiveFloat = 0.2
    moving: Literal["leave_out", "keep"] = "leave_out"
    images_per_stop: PositiveInt = 3
    walls: WallOptions = WallOptions()
    eye_to_hand: bool = False
    frames: FrameNames = FrameNames(world="base", tool="tool", camera="camera")
    modulation_frequency_hz: PositiveFloat | None = None
    saturation_amplitude: PositiveFloat | None = None
