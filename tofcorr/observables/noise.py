"""Measures the noise of a recording: how much, on what it depends, and how pixels share it."""

from dataclasses import dataclass
from typing import Literal

import numpy as np

from tofcorr.data.recording import Recording
from tofcorr.estimation.noise import nonnegative_coefficients
from tofcorr.estimation.statistics import student_quantile
from tofcorr.observables.frame_filter import (
    frame_correlation,
    shown_by_repeats,
    significant_correlation,
)
from tofcorr.observables.models import LEAST_VARIANCE, NoiseModel, filter_width
from tofcorr.observables.neighbour_noise import noise_from_neighbours
from tofcorr.observables.observed import Observed, observe
from tofcorr.observables.pixel_table import PixelTable
from tofcorr.observables.repeats_level import level_of_repeats

NoiseSource = Literal["repeats", "neighbours"]
"""`repeats`: frames taken without moving; `neighbours`: differences of pixels in one image, less
what images of different poses share, corrected for the correlation of the pixels compared, and to
the level of repeated frames, which count where there are any."""

# Noise comes from repeats if at least this share of the poses, or this many, was repeated: a level
# from fewer says little of the others. Chosen.
_REPEATED_SHARE = 0.5
_REPEATED_POSES = 8
# Bins of brightness, of equal count, that the curve is fitted to, and fewest pixels of one. As in
# `tofcorr.estimation.noise`; with 100 pixels the variance of a bin is known to 14 %.
_BINS = 24
_FEWEST_PER_BIN = 100
# The curve is extrapolated to the brightness that this share of the pixels is darker than. Chosen.
_DARKEST_SHARE = 1e-3


@dataclass(frozen=True, kw_only=True, eq=False)
class NoiseMeasurement:
    """The noise of a recording. Standard deviations are root mean squares over pixels, metres.

    Attributes:
        curve: Noise as a function of brightness.
        source: Where the temporal noise comes from.
        temporal_m: Of what changes from frame to frame, in one frame.
        temporal_interval: Its 95 % interval, with poses as the unit.
        pattern_m: Of the pattern that is the same in all poses, pixel by pixel.
        scene_m: Of what repeats within a pose and in no other: texture and edges of the target.
            None without repeats.
        correlation: Of the temporal noise of neighbours, shape (2, 2): along rows and columns, at
            lags 1 and 2.
        frame_correlation: Of successive frames of a pose, 0 if not significant: a filter in time.
        pose_frame_correlation: The same in each pose, shape (P,); NaN: fewer than three frames.
        num_poses: Number of poses.
        repeated_poses: How many of them have more than one frame.
        variance: Temporal variance of each row of the pixel table, m^2; NaN where unknown.
        pose_correlation: Correlation of nearest neighbours in each pose, shape (P,); NaN: unknown.
        left_out: Change of the logarithm of the mean variance, shape (P,), when a pose is left out
            of what all poses share: zeros from repeats.
        observed: What it was measured from.
    """

    curve: NoiseModel
    source: NoiseSource
    temporal_m: float
    temporal_interval: tuple[float, float]
    pattern_m: float
    scene_m: float | None
    correlation: np.ndarray
    frame_correlation: float
    pose_frame_correlation: np.ndarray
    num_poses: int
    repeated_poses: int
    variance: np.ndarray
    pose_correlation: np.ndarray
    left_out: np.ndarray
    observed: Observed


def measure_noise(recording: Recording) -> NoiseMeasurement:
    """Measure the noise of a recording.

    Args:
        recording: Any recording, real or simulated.

    Raises:
        CalibrationDataError: No image has 100 usable pixels, or a frame breaks the format.
    """
    return noise_of(observe(recording))


def noise_source(observed: Observed) -> NoiseSource:
    """Return where the noise of a recording can come from."""
    repeated = int((observed.repeats > 1).sum())
    if repeated >= min(_REPEATED_POSES, _REPEATED_SHARE * observed.num_poses):
        return "repeats"
    return "neighbours"


def noise_of(observed: Observed, source: NoiseSource | None = None) -> NoiseMeasurement:
    """Measure the noise of a recording that was read.

    Args:
        observed: What was read.
        source: Where the temporal noise comes from; None: from repeats, if there are enough.
    """
    source = source or noise_source(observed)
    table, poses = observed.table, range(observed.num_poses)
    of_frames = significant_correlation(np.concatenate(observed.between_frames, axis=1))
    repeats = table.of_repeats / shown_by_repeats(of_frames, observed.repeats)[table.pose]
    if source == "repeats":
        correlation = observed.temporal.correlation()
        variance = repeats
        by_pose = np.array([observed.temporal.correlation(k)[:, 0].mean() for k in poses])
        left_out = np.zeros(len(poses))
    else:
        variance, correlation, by_pose, left_out = noise_from_neighbours(observed)
        variance = variance * level_of_repeats(_brightness(table), repeats, variance)
        variance = np.where(np.isfinite(repeats), repeats, variance)
    temporal, interval = _level_of_poses(table.pose, variance)
    curve = fit_curve(table, variance, filter_width(correlation.mean(0).tolist()))
    if source == "neighbours":
        # Single pixels between edges have no difference; the curve covers them too. It has a least
        # noise where differences, less those of the pattern, leave none.
        everywhere = _mean_of_curve(table, curve)
        if temporal > 0:
            more = (everywhere / temporal) ** 0.5
            interval = interval[0] * more, interval[1] * more
        temporal = everywhere
    pattern, scene = _fixed(observed)
    share = pattern / (pattern + temporal) if pattern > 0 and temporal > 0 else 0.0
    return NoiseMeasurement(
        curve=curve.with_fixed_share(share),
        source=source,
        temporal_m=temporal**0.5,
        temporal_interval=interval,
        pattern_m=pattern**0.5,
        scene_m=None if scene is None else scene**0.5,
        correlation=correlation,
        frame_correlation=of_frames,
        pose_frame_correlation=np.array(
            [frame_correlation(one).value for one in observed.between_frames]
        ),
        num_poses=observed.num_poses,
        repeated_poses=int((observed.repeats > 1).sum()),
        variance=variance,
        pose_correlation=by_pose,
        left_out=left_out,
        observed=observed,
    )


def _level_of_poses(pose: np.ndarray, variance: np.ndarray) -> tuple[float, tuple[float, float]]:
    """Return the mean variance, m^2, and the 95 % interval of its root, metres, by poses."""
    known = np.isfinite(variance)
    if not known.any():
        return 0.0, (0.0, 0.0)
    _, number = np.unique(pose[known], return_inverse=True)
    sums, counts = np.bincount(number, variance[known]), np.bincount(number)
    mean = max(float(sums.sum() / counts.sum()), 0.0)
    poses = len(sums)
    if poses < 2:
        return mean, (0.0, float("inf"))
    error = np.sqrt(((sums - mean * counts) ** 2).sum() * poses / (poses - 1)) / counts.sum()
    reach = student_quantile(0.975, poses - 1) * float(error)
    return mean, (max(mean - reach, 0.0) ** 0.5, (mean + reach) ** 0.5)


def _fixed(observed: Observed) -> tuple[float, float | None]:
    """Return the variance of the pattern of all poses, and of what only a pose repeats, m^2."""
    pattern = observed.pattern.variance()
    repeated = observed.repeated[np.isfinite(observed.repeated)]
    if not len(repeated):
        return pattern, None
    within = max(float(repeated.mean()), 0.0)
    if observed.num_poses == 1:
        return within, 0.0
    return pattern, max(within - pattern, 0.0)


def _mean_of_curve(table: PixelTable, curve: NoiseModel) -> float:
    """Return the mean variance that the curve gives the pixels with a distance, m^2."""
    amplitude = None if curve.reference_amplitude is None else table.amplitude
    at = table.distance if amplitude is None else amplitude
    use = np.isfinite(at) & (at > 0) & (table.missing < table.frames)
    if not use.any():
        return 0.0
    sigma = curve.sigma(table.distance[use], None if amplitude is None else amplitude[use])
    return float((sigma**2).mean())


def fit_curve(table: PixelTable, variance: np.ndarray, correlation_px: float) -> NoiseModel:
    """Fit the noise curve to the variances of single pixels.

    Args:
        table: The pixels.
        variance: Temporal variance of each, shape (M,), m^2; NaN where unknown.
        correlation_px: Width of the filter that gives the correlation of neighbours, pixels.

    Returns:
        The curve of the temporal noise, without a fixed share.
    """
    lit = bool(np.isfinite(table.amplitude).any())
    reference = float(np.nanmedian(table.amplitude)) if lit else None
    distance = float(np.nanmedian(table.distance))
    brightness = _brightness(table) * (distance**2 if reference is None else 1.0 / reference)
    use = np.flatnonzero(np.isfinite(variance) & (np.nan_to_num(brightness) > 0))
    coefficients, least = np.zeros(3), 1.0
    if len(use):
        order = use[np.argsort(brightness[use], kind="stable")]
        count = int(np.clip(len(order) // _FEWEST_PER_BIN, 1, _BINS))
        parts = np.array_split(order, count)
        columns = np.array([[np.mean(brightness[p] ** -k) for k in range(3)] for p in parts])
        means = np.array([max(float(variance[p].mean()), LEAST_VARIANCE) for p in parts])
        coefficients = nonnegative_coefficients(columns, means)
        least = float(np.quantile(brightness[use], _DARKEST_SHARE))
    floor, shot, read = np.sqrt(coefficients).tolist()
    return NoiseModel(
        floor_m=floor,
        shot_m=shot,
        read_m=read,
        reference_amplitude=reference,
        reference_distance_m=distance,
        least_brightness=least,
        fixed_share=0.0,
        correlation_px=correlation_px,
    )


def _brightness(table: PixelTable) -> np.ndarray:
    """Return what the noise depends on, shape (M,): amplitude, or 1 / distance^2 without any."""
    if np.isfinite(table.amplitude).any():
        return table.amplitude
    return 1.0 / table.distance**2
