"""Reads a recording once and keeps what noise, missing pixels and amplitude are measured from."""

from dataclasses import dataclass

import numpy as np

from tofcorr.data.recording import Recording
from tofcorr.errors import CalibrationDataError
from tofcorr.observables.frame_filter import frame_differences
from tofcorr.observables.neighbours import (
    AXES,
    LAGS,
    BetweenPoses,
    LagSums,
    alike,
    differences,
    second_differences,
    shifted_pair,
)
from tofcorr.observables.pixel_table import PixelTable, sampled_pixels
from tofcorr.observables.pose_images import PoseImages, iterate_poses
from tofcorr.observables.stacks import clipped, known_mean, known_variance, repeated_variance


@dataclass(frozen=True, kw_only=True, eq=False)
class Observed:
    """What was read of one recording.

    Attributes:
        recording: Where it comes from.
        table: The sample of pixels.
        repeats: Number of frames of each pose, shape (P,).
        temporal: Correlation sums of deviations from the mean of repeated frames.
        within: Half squares of differences of neighbours in one image, and squares of second
            differences there.
        pattern: What the residuals of different poses share.
        pattern_differences: The same for the differences in `within`, by axis and lag.
        pattern_second: The same for the second differences, by axis.
        between_frames: Half the squared differences of frames one and two apart, of each pose,
            summed over tiles of the image, shape (2, T), m^2.
        repeated: Variance of the mean residual of each pose less that of its noise, shape (P,),
            m^2; NaN without repeats.
        map_missing: How often each pixel was missing, shape (H, W).
        map_frames: In how many frames it looked at the target, shape (H, W).
        pose_missing: Missing pixels of each pose, shape (P,).
        pose_saturated: Saturated pixels of each pose, shape (P,).
        pose_pixels: Pixels of each pose on the target, all frames, shape (P,).
    """

    recording: Recording
    table: PixelTable
    repeats: np.ndarray
    temporal: LagSums
    within: LagSums
    pattern: BetweenPoses
    pattern_differences: dict[tuple[int, int], BetweenPoses]
    pattern_second: dict[int, BetweenPoses]
    between_frames: list[np.ndarray]
    repeated: np.ndarray
    map_missing: np.ndarray
    map_frames: np.ndarray
    pose_missing: np.ndarray
    pose_saturated: np.ndarray
    pose_pixels: np.ndarray

    @property
    def num_poses(self) -> int:
        """Number of poses."""
        return len(self.repeats)


def observe(recording: Recording) -> Observed:
    """Read a recording.

    Args:
        recording: Any recording, real or simulated.

    Raises:
        CalibrationDataError: No image has 100 usable pixels, or a frame breaks the format.
    """
    names = sorted(set(recording.frames.target.tolist()))
    shape = (recording.camera.height, recording.camera.width)
    temporal, within, pattern = LagSums(), LagSums(), BetweenPoses(shape)
    differences_of = {(axis, lag): BetweenPoses(shape) for axis in AXES for lag in LAGS}
    second_of = {axis: BetweenPoses(shape) for axis in AXES}
    tables, repeated, between, counts = [], [], [], []
    map_missing, map_frames = np.zeros(shape), np.zeros(shape)
    for number, images in enumerate(iterate_poses(recording)):
        residual, weight = clipped(images.residual, images.amplitude)
        mean = known_mean(residual)
        pattern.add(mean, weight, images.corner)
        _add_temporal(temporal, residual - mean, images.amplitude)
        second = {axis: second_differences(residual, images.amplitude, axis) for axis in AXES}
        _add_within(within, differences_of, images, (residual, weight), second)
        for axis in AXES:
            second_of[axis].add(known_mean(second[axis]), weight, images.corner)
        repeated.append(repeated_variance(residual))
        between.append(frame_differences(residual))
        sampled = _sampled(images, shape)
        tables.append(
            _rows(images, residual, second, sampled, (number, names.index(images.target)))
        )
        map_missing[images.place] += images.missing.sum(0)
        map_frames[images.place] += images.on_target.sum(0)
        sums = (images.missing, images.saturated, images.on_target)
        counts.append([len(residual), *(each.sum() for each in sums)])
    table = PixelTable.join(tables)
    if not np.isfinite(table.distance).any():
        raise CalibrationDataError(
            f"{recording.path}: no image has 100 usable pixels on the target, as noise needs."
        )
    repeats, missing, saturated, pixels = np.array(counts).T
    return Observed(
        recording=recording,
        table=table,
        repeats=repeats,
        temporal=temporal,
        within=within,
        pattern=pattern,
        pattern_differences=differences_of,
        pattern_second=second_of,
        between_frames=between,
        repeated=np.array(repeated),
        map_missing=map_missing,
        map_frames=map_frames,
        pose_missing=missing,
        pose_saturated=saturated,
        pose_pixels=pixels,
    )


def _add_temporal(sums: LagSums, deviation: np.ndarray, amplitude: np.ndarray | None) -> None:
    """Add products of neighbouring deviations (R, H, W) from the mean of the repeats."""
    products, squares, counts = np.zeros((3, 2, 2))
    if len(deviation) > 1:
        for row, axis in enumerate(AXES):
            for column, lag in enumerate(LAGS):
                first, second = shifted_pair(deviation, axis, lag)
                both = np.isfinite(first) & np.isfinite(second)
                if amplitude is not None:
                    both &= alike(amplitude.mean(0), axis, lag)
                first, second = first[both], second[both]
                products[row, column] = first @ second
                squares[row, column] = (first @ first + second @ second) / 2
                counts[row, column] = len(first)
    sums.add(products, squares, counts)


def _add_within(
    sums: LagSums,
    shared: dict[tuple[int, int], BetweenPoses],
    images: PoseImages,
    weighted: tuple[np.ndarray, np.ndarray],
    second: dict[int, np.ndarray],
) -> None:
    """Add half squares of differences of neighbours, where there is a second difference too."""
    residual, weight = weighted
    squares, wide, counts = np.zeros((3, 2, 2))
    for row, axis in enumerate(AXES):
        for column, lag in enumerate(LAGS):
            found = differences(residual, images.amplitude, axis, lag) / 2**0.5
            at, _ = shifted_pair(second[axis], axis, lag)
            both = np.isfinite(found) & np.isfinite(at)
            squares[row, column] = (found[both] ** 2).sum()
            wide[row, column] = (at[both] ** 2).sum()
            counts[row, column] = both.sum()
            shared[axis, lag].add(
                known_mean(np.where(both, found, np.nan)),
                shifted_pair(weight, axis, lag)[0],
                images.corner,
            )
    sums.add(squares, wide, counts)


def _sampled(images: PoseImages, shape: tuple[int, int]) -> np.ndarray:
    """Return the sampled pixels of a pose that look at the target: flat, of the whole image."""
    on_target = np.zeros(shape, dtype=bool)
    on_target[images.place] = images.on_target.any(0)
    pixel = sampled_pixels(on_target.size)
    return pixel[on_target.ravel()[pixel]]


def _rows(
    images: PoseImages,
    residual: np.ndarray,
    second: dict[int, np.ndarray],
    pixel: np.ndarray,
    pose_and_target: tuple[int, int],
) -> PixelTable:
    """Return the rows of some pixels of a pose (flat, of the whole image)."""
    pose, target = pose_and_target
    row, column = np.divmod(pixel, images.image_width)
    chosen = (slice(None), row - images.corner[0], column - images.corner[1])
    values = residual[chosen]
    known = np.isfinite(values)
    squares = np.stack([known_mean(second[axis] ** 2)[chosen[1:]] for axis in AXES])
    nothing = np.full(len(pixel), np.nan)
    amplitude = raw = nothing
    if images.amplitude is not None:
        at = images.amplitude[chosen]
        amplitude = known_mean(np.where(known, at, np.nan)[:, None])[0]
        raw = known_mean(np.where(images.on_target[chosen], at, np.nan)[:, None])[0]
    return PixelTable(
        pose=np.full(len(pixel), pose),
        pixel=pixel,
        distance=images.distance[chosen[1:]],
        cosine=images.cosine[chosen[1:]],
        target=np.full(len(pixel), target),
        amplitude=amplitude,
        raw_amplitude=raw,
        of_repeats=known_variance(values),
        of_neighbours=known_mean(squares[:, None])[0],
        of_nearest=_of_nearest(residual, images.amplitude)[chosen[1:]],
        frames=images.on_target[chosen].sum(0),
        missing=images.missing[chosen].sum(0),
        saturated=images.saturated[chosen].sum(0),
    )


def _of_nearest(residual: np.ndarray, amplitude: np.ndarray | None) -> np.ndarray:
    """Return mean half squares of the differences to the nearest pixels, (H, W); NaN: none."""
    squares = []
    for axis in AXES:
        found = differences(residual, amplitude, axis, 1) ** 2 / 2
        line = np.full_like(residual.take([0], axis - 2), np.nan)
        squares += [np.concatenate(pair, axis - 2) for pair in ((line, found), (found, line))]
    return known_mean(np.concatenate(squares))
