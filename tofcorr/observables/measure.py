"""What a recording shows by itself: its noise, and its missing and saturated pixels.

Noise comes from frames taken without moving, or from differences of pixels in one image.
"""

import numpy as np

from tofcorr.estimation.noise import (
    SECOND_DIFFERENCE,
    SPACING,
    WIDEST_PX,
    ArrayT,
    NoiseModel,
    Source,
    brightness_bins,
    filter_width,
    fit_law,
    frame_correlation,
    mean_correlation,
    neighbour_correlation,
)
from tofcorr.estimation.robust import without_strays
from tofcorr.observables.read import FEWEST_PIXELS, LAGS, Observed, log_of, quotient
from tofcorr.options import Options, PositiveNumber, Share

LEAST_VARIANCE = float(np.square(np.finfo(np.float32).eps))
"""Square metres: less counts as free of noise, as float32 depth of 1 m is rounded by no more."""

# Standard errors that the correlation of frames must exceed to be counted, and the largest
# considered (no unit): the variance of a frame is corrected by the inverse of what is left. Chosen:
# one camera in 700 without a filter gets one.
_LEAST_ERRORS, _MOST_CORRELATED = 3.0, 0.95


class NoiseMeasurement:
    """The noise of a recording. Standard deviations are root mean squares over pixels, metres.

    Args:
        observed: What was read.
        source: Where the temporal noise comes from; None: from repeats, if there are enough.

    Attributes:
        curve: Noise as a function of brightness.
        source: Where the temporal noise comes from. From `neighbours` it is less what images of
            different poses share, corrected for the correlation of the pixels compared, and to the
            level of repeated frames, which count where there are any.
        temporal_m: Of what changes from frame to frame, in one frame.
        pattern_m: Of the pattern that is the same in all poses, pixel by pixel.
        correlation: Of the temporal noise of neighbours, shape (2, 2): along rows and columns, at
            lags 1 and 2.
        frame_correlation: Of successive frames of a pose, 0 if not significant: a filter in time.
        pose_frame_correlation: The same in each pose, shape (P,); NaN: fewer than three frames.
        variance: Temporal variance of each row of the pixel table, m^2; NaN where unknown.
        pose_correlation: Correlation of nearest neighbours in each pose, shape (P,); NaN: unknown.
        left_out: Change of the logarithm of the mean variance, shape (P,), when a pose is left out
            of what all poses share: zeros from repeats.
        observed: What it was measured from.
    """

    def __init__(self, observed: Observed, source: Source | None = None) -> None:
        self.observed = observed
        self.source: Source = source or noise_source(observed)
        table = observed.table
        found, error = frame_correlation(np.concatenate(observed.between_frames, axis=1))
        significant = found > _LEAST_ERRORS * error
        self.frame_correlation = min(found, _MOST_CORRELATED) if significant else 0.0
        by_pose = [frame_correlation(pose)[0] for pose in observed.between_frames]
        self.pose_frame_correlation = np.array(by_pose)
        counts = observed.repeats.tolist()
        shown = np.array([1.0 - mean_correlation(self.frame_correlation, one) for one in counts])
        repeats = table.of_repeats / shown[table.pose]
        if self.source == "repeats":
            products, squares, _ = observed.temporal.sum(0)
            self.correlation, self.variance = quotient(products, squares), repeats
            of_poses = quotient(observed.temporal[:, 0], observed.temporal[:, 1])
            self.pose_correlation = of_poses[..., 0].mean(-1)
            self.left_out = np.zeros(len(observed.repeats))
        else:
            found = _noise_of_neighbours(observed)
            variance, self.correlation, self.pose_correlation, self.left_out = found
            variance = variance * level_of_repeats(_brightness(table), repeats, variance)
            self.variance = np.where(np.isfinite(repeats), repeats, variance)
        curve = _curve_of(table, self.variance, filter_width(self.correlation.mean(0).tolist()))
        # Pixels at edges have no noise of their own; the curve covers them too. It has a least
        # noise where differences, less those of the pattern, leave none.
        at = table.amplitude if curve.needs_amplitude else table.distance
        lit = np.isfinite(at) & (at > 0) & (table.missing < table.frames)
        squares = curve.sigma(table.distance[lit], table.amplitude[lit]) ** 2
        temporal = float(squares.mean()) if lit.any() else 0.0
        pattern = observed.pattern
        share = pattern / (pattern + temporal) if pattern > 0 and temporal > 0 else 0.0
        self.curve = curve.with_fixed_share(share)
        self.temporal_m, self.pattern_m = temporal**0.5, pattern**0.5


def noise_source(observed: Observed) -> Source:
    """Return where the noise of a recording can come from.

    It comes from repeats if half of the poses, or eight, were repeated: a level from fewer says
    little of the others.
    """
    repeated = (observed.repeats > 1).sum()
    return "repeats" if repeated >= min(8, len(observed.repeats) / 2) else "neighbours"


def _noise_of_neighbours(
    observed: Observed,
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return the noise that differences of neighbours show.

    Second differences show a share of the variance: the pixels compared have a part of their noise
    in common. The share follows from the width of the filter, and this from how much smaller
    differences of nearer pixels are.

    Returns:
        The variance of each row of the pixel table, m^2, (M,), NaN where unknown; the correlation
        of neighbours, (2, 2), along rows and columns at lags 1 and 2; that of nearest neighbours in
        each pose, (P,); the change of the logarithm of the mean variance, (P,), when a pose is left
        out of the factors that all poses share.
    """
    total, table = observed.within.sum(0), observed.table

    def ratio_of(sums: np.ndarray) -> np.ndarray:
        """Return mean squares of differences over those of second differences (..., 2, 2)."""
        near, wide, counts = np.moveaxis(sums, -3, 0)
        return quotient(near, np.where(wide > LEAST_VARIANCE * counts, wide, 0.0))

    ratio, without = ratio_of(total), ratio_of(total - observed.within)
    share, *shares = _second_difference_share(np.concatenate([ratio[None], without])).tolist()
    # In the images of small squares most pixels have a neighbour of their brightness, but no second
    # difference: half the squared difference is that much smaller.
    nearest = table.of_nearest / ratio[:, 0].mean()
    at_edges = ~np.isfinite(table.of_neighbours) & np.isfinite(nearest)
    variance = np.where(at_edges, nearest, table.of_neighbours) / share
    edges = float(variance[at_edges].sum() / np.nansum(variance)) if at_edges.any() else 0.0
    left_out = -np.log(np.array(shares) / share)
    left_out -= edges * np.log(without[..., 0].mean(-1) / ratio[:, 0].mean())
    by_pose = 1.0 - share * ratio_of(observed.within)[..., 0].mean(-1)
    return variance, 1.0 - ratio * share, by_pose, np.nan_to_num(left_out)


def _second_difference_share(ratio: np.ndarray) -> np.ndarray:
    """Return the share of the variance that second differences show, of ratios (..., 2, 2).

    It is that of the filter whose ratios are the nearest; 1 where a ratio is unknown.
    """
    # A step changes the level by less than 2 %, and a parabola finds the width between them.
    widths = np.arange(0.0, WIDEST_PX, 0.02)
    lags = (*LAGS, SPACING, 2 * SPACING)
    correlation = np.array([[neighbour_correlation(w, lag) for lag in lags] for w in widths])
    share = 1.0 - correlation[:, 2:] @ [2.0, -0.5] / SECOND_DIFFERENCE
    near = (1.0 - correlation[:, :2]) / share[:, None]
    shares = []
    for wanted in ratio.mean(-2):
        misfit = ((near - wanted) ** 2).sum(-1)
        place = float(misfit.argmin())
        if 0 < place < len(widths) - 1:
            low, here, high = misfit[int(place) - 1 : int(place) + 2]
            place += (low - high) / (2.0 * (low - 2.0 * here + high))
        known = np.isfinite(misfit).all()
        shares.append(np.interp(place, np.arange(len(widths)), share) if known else 1.0)
    return np.array(shares)


def level_of_repeats(
    brightness: np.ndarray, repeats: np.ndarray, neighbours: np.ndarray
) -> np.ndarray:
    """Return the variance of repeats over that of neighbours, at each pixel's brightness.

    Neighbours also see the structure of a scene, such as the rim of saturated patches. It is where
    pixels are bright: one level for all would take it from the noise of the dark ones.

    Args:
        brightness: Of the pixels, any unit, shape (M,); NaN where unknown.
        repeats: Variance over repeated frames, shape (M,), m^2; NaN where there are none.
        neighbours: Variance by differences of neighbours, shape (M,), m^2; NaN where unknown.

    Returns:
        Shape (M,); 1 if fewer than 100 pixels have both variances.
    """
    lit = np.nan_to_num(brightness) > 0
    both = np.flatnonzero(np.isfinite(repeats) & np.isfinite(neighbours) & lit)
    # Three frames of a pose leave two degrees of freedom: five bins' pixels are known to 5 %.
    bins = brightness_bins(brightness[both], 5 * FEWEST_PIXELS)
    parts = [both[part] for part in bins if neighbours[both[part]].sum() > 0]
    if len(both) < FEWEST_PIXELS or not parts:
        return np.ones_like(neighbours)
    levels = [float(repeats[part].sum() / neighbours[part].sum()) for part in parts]
    at = [float(np.median(np.log(brightness[part]))) for part in parts]
    here = np.log(np.where(lit, brightness, np.exp(at[0])))
    return np.interp(here, at, levels)


def _curve_of(table: np.recarray, variance: np.ndarray, correlation_px: float) -> NoiseModel:
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
    use = np.isfinite(variance) & (np.nan_to_num(brightness) > 0)
    brightness, variance = brightness[use], variance[use]
    coefficients, least = np.zeros(3), 1.0
    if len(variance):
        parts = brightness_bins(brightness, FEWEST_PIXELS)
        columns = np.array([[np.mean(brightness[p] ** -k) for k in range(3)] for p in parts])
        means = np.array([max(float(variance[p].mean()), LEAST_VARIANCE) for p in parts])
        coefficients = fit_law(columns, means)
        least = without_strays(brightness)[0]  # Darker pixels are extrapolated.
    floor, shot, read = np.sqrt(coefficients).tolist()
    return NoiseModel(
        floor_m=floor,
        shot_m=shot,
        read_m=read,
        reference_amplitude=reference,
        reference_distance_m=distance,
        least_brightness=least,
        correlation_px=correlation_px,
    )


def _brightness(table: np.recarray) -> np.ndarray:
    """Return what the noise depends on, shape (M,): amplitude, or 1 / distance^2 without any."""
    lit = np.isfinite(table.amplitude).any()
    return table.amplitude if lit else 1.0 / table.distance**2


# Missing and saturated pixels: how many, where, and at which amplitude.


# Bins of ln amplitude that the model is fitted to: of equal count, and finer ones of the darkest
# pixels, of which a camera may lose only a few. Set by hand: finer than any transition width.
_BINS, _DARK_BINS = 200, 40
# Narrowest and widest transition, in ln amplitude. A sharper one is a step in every camera.
_WIDTHS = (0.01, 2.0)


class DropoutModel(Options):
    """The probability that a pixel gives no distance.

    Attributes:
        base_share: b, missing at any amplitude.
        amplitude_at_half: A_1/2, counts; null: the amplitude plays no part, or is not recorded.
        width: w, of the transition in ln A: from 73 % to 27 % missing within two widths.
        saturation_amplitude: The largest amplitude that the camera states, counts; a pixel that
            reaches it is not valid. Null: unknown.
        saturated_share: Share of those pixels that have no distance; null: as darker ones.
    """

    base_share: Share = 0.0
    amplitude_at_half: PositiveNumber | None = None
    width: PositiveNumber = 0.1
    saturation_amplitude: PositiveNumber | None = None
    saturated_share: Share | None = None

    @property
    def needs_amplitude(self) -> bool:
        """Whether anything depends on the amplitude."""
        return not (self.amplitude_at_half is self.saturation_amplitude is None)

    def probability(self, amplitude: ArrayT) -> ArrayT:
        """Return the probability that pixels of these amplitudes are missing; same shape.

        Saturated pixels count as others here, unless `saturated_share` is known.
        """
        share = amplitude * 0.0 + self.base_share
        if self.amplitude_at_half is not None:
            # No power of the share of the threshold overflows: e^-80 is nothing, e^80 a float32.
            brightest = np.exp(80 * self.width)
            relative = (amplitude / self.amplitude_at_half).clip(min=0.0, max=brightest)
            share = share + (1.0 - self.base_share) / (1.0 + relative ** (1.0 / self.width))
        if self.saturated_share is not None:
            saturated = self.saturated(amplitude)
            share = share * ~saturated + self.saturated_share * saturated
        return share

    def saturated(self, amplitude: ArrayT) -> ArrayT:
        """Return where pixels are saturated, bool, same shape."""
        level = self.saturation_amplitude
        return amplitude >= (np.inf if level is None else level)


class DropoutMeasurement:
    """Missing and saturated pixels of a recording, among those on the target.

    Without a mask, every pixel counts as on the target.

    Args:
        observed: What was read.

    Attributes:
        model: The probability that a pixel is missing.
        share: Share without a distance.
        saturated_missing: Share that is saturated and has no distance.
        map: Share of each pixel, shape (H, W); NaN where it never looked at the target.
        border_share: Share in the outer eighth of the image on each side.
        centre_share: Share in the rest.
        amplitude: Amplitude of each row of the pixel table, counts, also where a pixel is missing;
            NaN where unknown.
        observed: What it was measured from.
    """

    def __init__(self, observed: Observed) -> None:
        self.observed, table = observed, observed.table
        self.amplitude = _amplitude_everywhere(observed)
        saturation = _saturation(observed, self.amplitude)
        self.model = _likeliest(observed, self.amplitude, saturation)
        beyond = self.model.saturated(self.amplitude)
        self.saturated_missing = float(table.missing[beyond].sum() / max(table.frames.sum(), 1))
        missing, seen = observed.map_missing, observed.map_frames
        self.map, self.share = quotient(missing, seen), float(missing.sum() / max(seen.sum(), 1))
        height, width = seen.shape
        border = np.ones((height, width), dtype=bool)
        border[height // 8 : height - height // 8, width // 8 : width - width // 8] = False
        self.border_share, self.centre_share = (
            float(missing[where].sum() / max(seen[where].sum(), 1)) for where in (border, ~border)
        )


def _saturation(observed: Observed, amplitude: np.ndarray) -> float | None:
    """Return the saturation amplitude.

    If the recording does not state it, it is where many pixels share the largest amplitude: random
    ones hardly ever agree.
    """
    if observed.recording.saturation_amplitude is not None:
        return observed.recording.saturation_amplitude
    known = amplitude[np.isfinite(amplitude)]
    piled = int((known == known.max()).sum()) if len(known) else 0
    return float(known.max()) if piled >= max(20, len(known) / 10_000) else None


def _likeliest(observed: Observed, amplitude: np.ndarray, saturation: float | None) -> DropoutModel:
    """Fit the model by maximum likelihood."""
    from scipy.optimize import minimize  # Slow to import; only recordings with gaps need them.
    from scipy.special import expit, logit

    table, plain = observed.table, DropoutModel(saturation_amplitude=saturation)
    other = ~plain.saturated(amplitude)  # Saturated pixels are missing for another reason.
    total = table.frames[other].sum()
    share = float(table.missing[other].sum() / max(total, 1))
    plain = plain.model_copy(update={"base_share": share})
    use = other & (np.nan_to_num(amplitude) > 0)
    missing, frames, at = table.missing[use], table.frames[use], np.log(amplitude[use])
    if not missing.sum():
        return plain
    darkest = np.geomspace(1.0 / len(at), 1.0 / _BINS, _DARK_BINS)
    edges = np.unique(np.quantile(at, [*np.linspace(0.0, 1.0, _BINS + 1), *darkest]))
    place = np.clip(np.searchsorted(edges, at, side="right") - 1, 0, max(len(edges) - 2, 0))
    count, lost, sums = (np.bincount(place, each) for each in (frames, missing, frames * at))
    centre = sums / np.maximum(count, 1)

    def model(x: np.ndarray) -> DropoutModel:
        """Return the model of the logit of the base, ln threshold and ln width."""
        base, width = float(expit(x[0])), float(np.exp(x[2]).clip(*_WIDTHS))
        changes = {"base_share": base, "amplitude_at_half": float(np.exp(x[1])), "width": width}
        return plain.model_copy(update=changes)

    def unlikely(probability: np.ndarray | float) -> float:
        """Return the negative log likelihood."""
        sure = np.clip(probability, np.finfo(float).eps, 1.0 - np.finfo(float).eps)
        return float(-(lost * np.log(sure) + (count - lost) * np.log1p(-sure)).sum())

    base = missing.sum() / frames.sum()
    # Half of what is missing, at the median amplitude of the missing pixels.
    start = [logit(base / 2), np.median(np.repeat(at, missing)), np.log(plain.width)]
    best = minimize(
        lambda x: unlikely(model(x).probability(np.exp(centre))), start, method="Nelder-Mead"
    )
    # Half the 95 % quantile of chi-square with two degrees of freedom, for each pose with any.
    if unlikely(base) - best.fun < 3 * max(observed.losing_poses, 1):
        return plain
    found = model(best.x)
    return found if found.base_share * total >= 1 else found.model_copy(update={"base_share": 0.0})


def _amplitude_everywhere(observed: Observed) -> np.ndarray:
    """Return the amplitude of each row of the pixel table, counts, (M,); NaN where unknown.

    Where the camera writes no amplitude for missing pixels, it is that of the pixels around the
    same target: cos / d^2 times the fall-off of the lens, fitted in ln amplitude.
    """
    table = observed.table
    lost = table.missing > 0
    raw = table.raw_amplitude
    positive = np.isfinite(raw[lost]) & (raw[lost] > 0)
    if not np.isfinite(raw).any() or not lost.any() or positive.mean() >= 0.5:
        return raw
    known = np.isfinite(table.amplitude) & ~lost
    return np.where(known, table.amplitude, _light_law(observed))


def _light_law(observed: Observed) -> np.ndarray:
    """Return the amplitude that the law of light predicts for each row, counts."""
    table, (height, width) = observed.table, observed.map_frames.shape
    row, column = table.pixel // width, table.pixel % width
    radius = np.hypot(row - (height - 1) / 2, column - (width - 1) / 2) / np.hypot(height, width)
    columns = [radius**power for power in (0, 2, 4)]
    columns += [(table.target == number) * 1.0 for number in np.unique(table.target)[1:]]
    design = np.stack(columns, axis=1)
    signal = log_of(table.signal)
    known = np.isfinite(signal) & np.isfinite(table.amplitude) & (table.amplitude > 0)
    if known.sum() < design.shape[1]:
        return np.full(len(table), np.nan)
    wanted = np.log(table.amplitude[known]) - signal[known]
    solution = np.linalg.lstsq(design[known], wanted, rcond=None)[0]
    return np.exp(signal + design @ solution)
