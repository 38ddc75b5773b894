"""The images of one pose: deviations from a smooth surface, amplitude, missing pixels."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import torch

from tofcorr.data.frames import iterate_frames
from tofcorr.data.recording import Recording
from tofcorr.observables.pose_groups import pose_groups
from tofcorr.observables.stacks import known_mean
from tofcorr.observables.surface import SurfaceFit

# Frames of a pose that are read at most: 30 give the variance of a pixel to 26 %, and the mean over
# thousands of pixels far better. Chosen to bound time and memory.
_MOST_REPEATS = 30


@dataclass(frozen=True, kw_only=True, eq=False)
class PoseImages:
    """The R frames of one pose, cut to the rectangle of h x w pixels that holds the target.

    Attributes:
        residual: Measured distance less the smooth surface of the mean image, and less the offset
            of the frame, shape (R, h, w), metres; NaN where not usable.
        amplitude: Counts, shape (R, h, w), as recorded; None if not recorded.
        on_target: Where the pixels look at the target, shape (R, h, w), bool.
        missing: Pixels on the target without a distance, shape (R, h, w), bool.
        saturated: Pixels on the target at or above the stated saturation, shape (R, h, w), bool.
        distance: To the plane of the images, shape (h, w), metres; NaN where unknown.
        cosine: Of the angle of incidence on that plane, shape (h, w); NaN where unknown.
        target: Name of the target.
        corner: Row and column of the rectangle's first pixel.
        image_width: Of the whole image, W.
    """

    residual: np.ndarray
    amplitude: np.ndarray | None
    on_target: np.ndarray
    missing: np.ndarray
    saturated: np.ndarray
    distance: np.ndarray
    cosine: np.ndarray
    target: str
    corner: tuple[int, int]
    image_width: int

    @property
    def place(self) -> tuple[slice, slice]:
        """Where the rectangle lies in the image."""
        (row, column), (height, width) = self.corner, self.distance.shape
        return slice(row, row + height), slice(column, column + width)


def iterate_poses(recording: Recording) -> Iterator[PoseImages]:
    """Yield the images of every pose, in the order of the first frames.

    Args:
        recording: The recording.

    Raises:
        CalibrationDataError: A frame holds a value that the format does not allow.
    """
    fit = SurfaceFit(recording.camera)
    for frames in pose_groups(recording):
        yield _images(recording, frames[:_MOST_REPEATS], fit)


def _images(recording: Recording, frames: np.ndarray, fit: SurfaceFit) -> PoseImages:
    batches = list(iterate_frames(recording, frames))
    whole = torch.cat([batch.valid for batch in batches]).numpy()
    mask = recording.read("mask", frames)
    on_target = np.ones_like(whole) if mask is None else mask.astype(bool)
    place = _around(on_target)
    cut = (slice(None), *place)
    on_target, valid = on_target[cut], whole[cut]
    distance = torch.cat([batch.radial_distance[cut] for batch in batches]).numpy()
    amplitude = None
    if recording.amplitude is not None:
        strengths = [b.amplitude[cut] for b in batches if b.amplitude is not None]
        amplitude = torch.cat(strengths).numpy()
    returned = np.isfinite(distance) & (np.nan_to_num(distance) > 0)
    saturated = np.zeros_like(valid)
    if amplitude is not None and recording.saturation_amplitude is not None:
        saturated = on_target & (amplitude >= recording.saturation_amplitude)
    usable = np.where(valid, distance, np.nan)
    mean = known_mean(usable)
    surface = fit(mean, np.isfinite(mean), place)
    unknown = np.full(mean.shape, np.nan)
    return PoseImages(
        residual=_residual(usable, mean, unknown if surface is None else surface.residual),
        amplitude=amplitude,
        on_target=on_target,
        missing=on_target & ~returned,
        saturated=saturated,
        distance=unknown if surface is None else surface.distance,
        cosine=unknown if surface is None else surface.cosine,
        target=str(recording.frames.target[frames[0]]),
        corner=(place[0].start, place[1].start),
        image_width=whole.shape[2],
    )


def _around(on_target: np.ndarray) -> tuple[slice, slice]:
    """Return the smallest rectangle of the image that holds the target in (R, H, W); all: none."""
    sides = []
    for axes, size in (((0, 2), on_target.shape[1]), ((0, 1), on_target.shape[2])):
        seen = np.flatnonzero(on_target.any(axes))
        sides.append(slice(int(seen[0]), int(seen[-1]) + 1) if len(seen) else slice(0, size))
    return sides[0], sides[1]


def _residual(usable: np.ndarray, mean: np.ndarray, of_mean: np.ndarray) -> np.ndarray:
    """Return each frame (R, H, W) less the surface of their mean and less its own offset."""
    around = usable - mean
    offset = np.zeros((len(usable), 1, 1))
    for frame in range(len(usable)):
        known = around[frame][np.isfinite(around[frame])]
        offset[frame] = np.median(known) if len(usable) > 1 and len(known) else 0.0
    return around - offset + of_mean
