"""Depth images that a camera took while a robot moved: read, paired with poses, and chosen."""

from collections.abc import Callable, Sequence
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
from tofcorr.importing.images import DepthImage
from tofcorr.importing.pose_track import PoseTrack
from tofcorr.importing.run import Refused, RefusedViewError, Sieve
from tofcorr.importing.timing import Lag, find_stops, pair
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
        camera: The camera's intrinsics.
        read: Reads one image by its number; raises `RefusedViewError` if it cannot be used.
        track: Poses of the tool in the robot's base.
        times: Seconds on the camera's clock, shape (I,), increasing; None without times.
        refused: Images that the source has left out already.
        warnings: What the source has to say, sentences for people.
        targets: Which wall each image shows, shape (I,), text; None: walls are looked for.
        tool_from_camera: The hand-eye transform where it is known, shape (4, 4); else None.
        camera_frame: What the images call the camera's frame; empty if they do not.
    """

    origin: str
    names: Sequence[str]
    camera: CameraIntrinsics
    read: Callable[[int], DepthImage]
    track: PoseTrack
    times: np.ndarray | None = None
    refused: Refused = field(default_factory=dict)
    warnings: Sequence[str] = ()
    targets: np.ndarray | None = None
    tool_from_camera: np.ndarray | None = None
    camera_frame: str = ""


def look(
    images: RobotImages, sieve: Sieve, looked_at: int = 4096
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Read every image once, and keep a few numbers of each.

    Args:
        images: The images.
        sieve: Sets aside the images that cannot be read.
        looked_at: Pixels of an image that are compared with the image before: their median change
            is known to a sixtieth of the noise, a fraction of a millimetre.

    Returns:
        Which images can be read, shape (I,), bool; the median depth of each, metres, NaN without
        returns; and the median absolute difference to the readable image before, metres, NaN for
        the first one, or where no pixel has a return in both.

    Raises:
        CalibrationDataError: No image can be used.
    """
    median, change = (np.full(len(images.names), np.nan) for _ in range(2))
    before = np.zeros(0)

    def read(k: int) -> int:
        nonlocal before
        depth = images.read(k).depth
        few = depth.ravel()[:: max(1, depth.size // looked_at)]
        if np.isfinite(few).any():
            median[k] = np.nanmedian(few)
        if len(before) and np.isfinite(moved := np.abs(few - before)).any():
            change[k] = np.nanmedian(moved)
        before = few
        return k

    every = sieve.progress(range(len(images.names)), "looking at images")
    readable = np.isin(np.arange(len(median)), sieve.apply(read, every, images.names.__getitem__))
    return readable, median, change


class ImagesOfPlanes:
    """Reads images as distances along the ray, and remembers their planes: some hundred numbers.

    Args:
        source: The images.
        options: What depth means, which amplitudes are saturated, and how planes are found.

    Attributes:
        rays: Unit viewing rays, shape (H, W, 3).
    """

    def __init__(self, source: RobotImages, options: PosedOptions) -> None:
        self.source, self.rays = source, ray_directions(source.camera)
        self._options = options
        self._planes: dict[int, list[ImagePlane]] = {}

    def read(self, number: int) -> DepthImage:
        """Return an image that was readable before.

        Raises:
            CalibrationDataError: It cannot be read any more.
        """
        try:
            return self.source.read(number)
        except RefusedViewError as refusal:
            raise CalibrationDataError(
                f"{self.source.origin}: {refusal}; it was readable at the start of the import. "
                "Were the files changed?"
            ) from None

    def planes(self, number: int) -> list[ImagePlane]:
        """Return the planes of an image, found once."""
        if number not in self._planes:
            self._planes[number] = self.planes_in(self.read(number))
        return self._planes[number]

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


@dataclass(frozen=True, kw_only=True, eq=False)
class Chosen:
    """Images with poses.

    Attributes:
        images: Their numbers in the source, shape (N,), increasing.
        world_from_tool: Shape (N, 4, 4), metres, as the poses' file has them.
        stop: The stop that each belongs to, shape (N,); -1 while moving.
        moving: Images with a pose that were taken while the tool moved, shape (K,).
        refused: Images left out, and why.
        paired_by: `time`, `name` or `order`.
    """

    images: np.ndarray
    world_from_tool: np.ndarray
    stop: np.ndarray
    moving: np.ndarray
    refused: Refused
    paired_by: str


def choose(
    names: Sequence[str],
    times: np.ndarray | None,
    usable: np.ndarray,
    track: PoseTrack,
    options: PosedOptions,
    lag: Lag | None,
    margin: float = 0.02,
) -> Chosen:
    """Pair images with poses, and keep those of stops.

    Args:
        names: What each image is called.
        times: On the images' clock, shape (I,), seconds; None without times.
        usable: Which images can be read, shape (I,), bool.
        track: The poses.
        options: How to choose.
        lag: Of the images' clock; None: none is known.
        margin: Seconds before and after an image in which the tool must stand still besides the
            uncertainty of the lag: an exposure and the jitter of a time stamp.

    Raises:
        CalibrationDataError: No image is left.
    """
    lag = lag or Lag(seconds=0.0)
    images, poses, refused, by = pair(
        names, times, track, tolerance=options.pose_tolerance_s, lag=lag.seconds
    )
    kept = usable[images]
    images, poses = images[kept], poses[kept]
    if times is None or track.timestamp is None:
        stop = np.arange(len(images))
    elif track.lists_stops(options.pose_tolerance_s):
        stop = track.nearest(times[images] - lag.seconds)
    else:
        stop = find_stops(track, times[images] - lag.seconds, margin + 2 * lag.standard_error)
    take, moving = stop < 0, images[stop < 0]
    if options.moving == "leave_out":
        refused |= {names[int(k)]: "the tool was moving" for k in moving}
        take = np.zeros(len(stop), dtype=bool)
    # At most so many images of a stop, evenly spread, the middle first.
    for number in np.unique(stop[stop >= 0]):
        own = np.flatnonzero(stop == number)
        count = min(options.images_per_stop, len(own))
        take[own[((np.arange(count) + 0.5) * len(own) / count).astype(int)]] = True
    reason = f"its stop has {options.images_per_stop} images already"
    refused |= {names[int(k)]: reason for k in images[(stop >= 0) & ~take]}
    if not take.any():
        raise CalibrationDataError(
            f"{track.source}: the tool moves in all of {len(images)} images that have a pose. Stop "
            "the robot for each image, or add --keep-moving (each millisecond of lag then counts)."
        )
    return Chosen(
        images=images[take],
        world_from_tool=poses[take],
        stop=stop[take],
        moving=moving,
        refused=refused,
        paired_by=by,
    )
