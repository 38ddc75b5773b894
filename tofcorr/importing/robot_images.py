"""Depth images that a camera took while a robot moved: read, paired with poses, and chosen."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
import torch
from pydantic import Field, PositiveFloat, PositiveInt
from torch import Tensor

from tofcorr.data.recording import DepthKind, FrameNames
from tofcorr.errors import CalibrationDataError
from tofcorr.geometry.camera import CameraIntrinsics
from tofcorr.geometry.rays import ray_directions
from tofcorr.importing.images import DepthImage, of_size
from tofcorr.importing.intrinsics import GivenIntrinsics
from tofcorr.importing.pose_track import PoseTrack
from tofcorr.importing.run import Refused, RefusedViewError, Sieve
from tofcorr.importing.walls.image_planes import ImagePlane, WallOptions, planes_of_image
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


@dataclass(frozen=True, kw_only=True, eq=False)
class RobotImages:
    """Images of one camera in the order of their times, and the poses of the robot that moved it.

    Attributes:
        origin: Where the images come from, for messages.
        names: What each image is called.
        intrinsics: Of the camera.
        read: Reads one image by its number; raises `RefusedViewError` if it cannot be used.
        track: Poses of the tool in the robot's base.
        times: Seconds on the camera's clock, shape (I,), increasing; None without times.
        refused: Images that the source has left out already.
        warnings: What the source has to say, sentences for people.
        targets: Which wall each image shows, shape (I,), text; None: walls are looked for.
        planes: Where each of these walls was measured, (nx, ny, nz, d) of n . x + d = 0 in the
            world of the recording, metres, by name; None: walls are estimated.
        tool_from_camera: The hand-eye transform where it is known, shape (4, 4); else None.
        camera_frame: What the images call the camera's frame; empty if they do not.
    """

    origin: str
    names: Sequence[str]
    intrinsics: GivenIntrinsics
    read: Callable[[int], DepthImage]
    track: PoseTrack
    times: np.ndarray | None = None
    refused: Refused = field(default_factory=dict)
    warnings: Sequence[str] = ()
    targets: np.ndarray | None = None
    planes: Mapping[str, np.ndarray] | None = None
    tool_from_camera: np.ndarray | None = None
    camera_frame: str = ""


class ImagesOfPlanes:
    """Reads images as distances along the ray, and remembers their planes: some hundred numbers.

    Args:
        source: The images.
        options: What depth means, which amplitudes are saturated, and how planes are found.
        planes: Those of images that were seen before, by their names; further ones are added.

    Attributes:
        camera: Of the size of the first image that could be read; `look` finds it.
        rays: Unit viewing rays, shape (H, W, 3).
    """

    camera: CameraIntrinsics
    rays: Tensor

    def __init__(
        self,
        source: RobotImages,
        options: PosedOptions,
        planes: dict[str, list[ImagePlane]] | None = None,
    ) -> None:
        self.source, self._options = source, options
        self._planes = {} if planes is None else planes

    def look(self, sieve: Sieve) -> tuple[np.ndarray, np.ndarray]:
        """Read every image once, and keep a few numbers of each.

        Args:
            sieve: Sets aside the images that cannot be read.

        Returns:
            Which images can be read, shape (I,), bool; and the median absolute difference to the
            readable image before, metres, NaN for the first one, or where no pixel has a return in
            both.

        Raises:
            CalibrationDataError: No image can be used, or the intrinsics hold for another size.
        """
        names = self.source.names
        change, before = np.full(len(names), np.nan), np.zeros(0)

        def read(k: int) -> int:
            nonlocal before
            image = self.source.read(k)
            if not len(before):
                height, width = image.depth.shape
                self.camera = self.source.intrinsics.camera((width, height))
                self.rays = ray_directions(self.camera)
            depth = of_size(image, self.camera).depth
            # The median change of so many pixels is known to a sixtieth of their noise.
            few = depth.ravel()[:: max(1, depth.size // 4096)]
            if len(before) and np.isfinite(moved := np.abs(few - before)).any():
                change[k] = np.nanmedian(moved)
            before = few
            return k

        readable = sieve.apply(read, range(len(names)), names.__getitem__, "looking at images")
        return np.isin(np.arange(len(names)), readable), change

    def read(self, number: int) -> DepthImage:
        """Return an image that was readable before.

        Raises:
            CalibrationDataError: It cannot be read any more.
        """
        try:
            return of_size(self.source.read(number), self.camera)
        except RefusedViewError as refusal:
            raise CalibrationDataError(f"{self.source.origin} was changed: {refusal}.") from None

    def planes(self, number: int) -> list[ImagePlane]:
        """Return the planes of an image, found once."""
        name = self.source.names[number]
        if name not in self._planes:
            self._planes[name] = self.planes_in(self.read(number))
        return self._planes[name]

    def planes_in(self, image: DepthImage) -> list[ImagePlane]:
        """Find the planes of an image of this camera."""
        named, options = self.source.targets is not None, self._options.walls
        return planes_of_image(*self.along_rays(image), self.rays, options, named=named)

    def along_rays(self, image: DepthImage) -> tuple[Tensor, Tensor]:
        """Return distances along the ray in metres, and where they are usable, both (H, W)."""
        distance = torch.from_numpy(image.depth).double()
        if self._options.depth_kind == "z":
            distance = distance / self.rays[..., 2]
        valid = distance.isfinite() & (distance > 0)
        if self._options.saturation_amplitude is not None and image.amplitude is not None:
            valid &= torch.from_numpy(image.amplitude) < self._options.saturation_amplitude
        return distance.nan_to_num(0.0), valid
