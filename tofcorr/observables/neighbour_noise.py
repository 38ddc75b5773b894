"""The noise of a recording without repeated frames, from differences of neighbouring pixels."""

from typing import NamedTuple

import numpy as np

from tofcorr.observables.models import LEAST_VARIANCE, WIDEST_PX, neighbour_correlation
from tofcorr.observables.neighbours import AXES, LAGS, SPACING, quotient
from tofcorr.observables.observed import Observed

# Step of the widths that are tried for the filter of noise, pixels. Chosen: it changes the level by
# less than 2 %, and a parabola finds the width between them.
_WIDTH_STEP = 0.02


class NeighbourNoise(NamedTuple):
    """The noise that differences of neighbours show.

    Attributes:
        variance: Of each row of the pixel table, m^2, shape (M,); NaN where unknown.
        correlation: Of neighbours, shape (2, 2): along rows and columns, at lags 1 and 2.
        pose_correlation: Of nearest neighbours in each pose, shape (P,).
        left_out: Change of the logarithm of the mean variance, shape (P,), when a pose is left out
            of the factors that all poses share.
    """

    variance: np.ndarray
    correlation: np.ndarray
    pose_correlation: np.ndarray
    left_out: np.ndarray


def noise_from_neighbours(observed: Observed) -> NeighbourNoise:
    """Return the noise of a recording that was read.

    Second differences show a share of the variance: the pixels compared have a part of their noise
    in common. The share follows from the width of the filter, and this from how much smaller
    differences of nearer pixels are.
    """
    within = observed.within
    own = [np.array(sums) for sums in (within.products, within.squares, within.counts)]
    total = [sums.sum(0) for sums in own]
    ratio = _difference_ratio(observed, *total)
    others = [all_poses - sums for all_poses, sums in zip(total, own, strict=True)]
    without = _difference_ratio(observed, *others)
    share, *shares = _second_difference_share(np.concatenate([ratio[None], without])).tolist()
    raw = observed.table.of_neighbours - _shared_second(observed)
    # In the images of small squares most pixels have a neighbour of their brightness, but no second
    # difference: half the squared difference is that much smaller.
    nearest = (observed.table.of_nearest - _shared_first(observed)) / ratio[:, 0].mean()
    at_edges = ~np.isfinite(raw) & np.isfinite(nearest)
    variance = np.where(at_edges, nearest, raw) / share
    edges = float(variance[at_edges].sum() / np.nansum(variance)) if at_edges.any() else 0.0
    left_out = -np.log(np.array(shares) / share)
    left_out -= edges * np.log(without[..., 0].mean(-1) / ratio[:, 0].mean())
    return NeighbourNoise(
        variance=variance,
        correlation=1.0 - ratio * share,
        pose_correlation=1.0 - share * _difference_ratio(observed, *own)[..., 0].mean(-1),
        left_out=np.nan_to_num(left_out),
    )


def _shared_first(observed: Observed) -> float:
    """Return half the variance of differences to nearest pixels that a pattern explains, m^2."""
    return float(np.mean([observed.pattern_differences[axis, 1].variance() for axis in AXES]))


def _shared_second(observed: Observed) -> float:
    """Return the variance of second differences that a fixed pattern explains, m^2."""
    return float(np.mean([observed.pattern_second[axis].variance() for axis in AXES]))


def _difference_ratio(
    observed: Observed, products: np.ndarray, squares: np.ndarray, counts: np.ndarray
) -> np.ndarray:
    """Return mean squares of differences over those of second differences, less the pattern's.

    Args:
        observed: What was read.
        products: Sums of the former, shape (..., 2, 2): axes by lags.
        squares: Sums of the latter.
        counts: Numbers of pixels.
    """
    pattern = observed.pattern_differences
    shared = np.array([[pattern[axis, lag].variance() for lag in LAGS] for axis in AXES])
    narrow = products - shared * counts
    wide = squares - _shared_second(observed) * counts
    return quotient(narrow, np.where(wide > LEAST_VARIANCE * counts, wide, 0.0))


def _second_difference_share(ratio: np.ndarray) -> np.ndarray:
    """Return the share of the variance that second differences show, of ratios (..., 2, 2).

    It is that of the filter whose ratios are the nearest, between the widths that are tried by a
    parabola; 1 where a ratio is unknown.
    """
    widths = np.arange(0.0, WIDEST_PX, _WIDTH_STEP)
    share = np.array([_share_of_width(width) for width in widths])
    near = np.array([[1.0 - neighbour_correlation(w, lag) for lag in LAGS] for w in widths])
    wanted = ratio.mean(-2)
    misfit = ((near / share[:, None] - wanted[..., None, :]) ** 2).sum(-1)
    known = np.isfinite(misfit).all(-1)
    least = np.where(known[..., None], misfit, 0.0).argmin(-1)
    middle = least.clip(1, len(widths) - 2)
    low, here, high = (
        np.take_along_axis(misfit, (middle + step)[..., None], -1)[..., 0] for step in (-1, 0, 1)
    )
    bend = low - 2.0 * here + high
    step = np.divide(low - high, 2.0 * bend, out=np.zeros_like(bend), where=bend > 0)
    place = np.where(least == middle, middle + step.clip(-0.5, 0.5), least)
    return np.where(known, np.interp(place, np.arange(len(widths)), share), 1.0)


def _share_of_width(width_px: float) -> float:
    """Return the share of the variance that scaled second differences of filtered noise show."""
    near, far = (neighbour_correlation(width_px, k * SPACING) for k in (1, 2))
    return (1.5 - 2.0 * near + 0.5 * far) / 1.5
