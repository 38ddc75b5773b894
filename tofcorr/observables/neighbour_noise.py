"""The noise of a recording without repeated frames, from differences of neighbouring pixels."""

from collections.abc import Iterable

import numpy as np

from tofcorr.observables.filter_width import WIDEST_PX, neighbour_correlation
from tofcorr.observables.neighbours import AXES, LAGS, SPACING, quotient
from tofcorr.observables.noise_curve import LEAST_VARIANCE
from tofcorr.observables.observed import Observed

# Step of the widths that are tried for the filter of noise, pixels. Chosen: it changes the level by
# less than 2 %.
_WIDTH_STEP = 0.02


def noise_from_neighbours(observed: Observed) -> tuple[np.ndarray, np.ndarray, float]:
    """Return the variance of each row, m^2, the correlation (2, 2), and the share of differences.

    The share is that of the variance which second differences show: pixels that are compared share
    a part of their noise. It follows from the width of the filter, and this from how much smaller
    differences of nearer pixels are.
    """
    ratio = difference_ratio(observed, range(observed.num_poses))
    widths = np.arange(0.0, WIDEST_PX, _WIDTH_STEP)
    share = np.array([second_difference_share(width) for width in widths])
    near = np.array([[1.0 - neighbour_correlation(w, lag) for lag in LAGS] for w in widths])
    misfit = ((near / share[:, None] - ratio.mean(0)) ** 2).sum(1)
    chosen = 0 if np.isnan(misfit).any() else int(misfit.argmin())
    raw = observed.table.of_neighbours - _shared_second(observed)
    # In the images of small squares most pixels have a neighbour of their brightness, but no second
    # difference: half the squared difference is that much smaller.
    nearest = (observed.table.of_nearest - _shared_first(observed)) / ratio[:, 0].mean()
    raw = np.where(np.isfinite(raw), raw, nearest)
    return raw / share[chosen], 1.0 - ratio * share[chosen], float(share[chosen])


def _shared_first(observed: Observed) -> float:
    """Return half the variance of differences to nearest pixels that a pattern explains, m^2."""
    return float(np.mean([observed.pattern_differences[axis, 1].variance() for axis in AXES]))


def _shared_second(observed: Observed) -> float:
    """Return the variance of second differences that a fixed pattern explains, m^2."""
    return float(np.mean([observed.pattern_second[axis].variance() for axis in AXES]))


def difference_ratio(observed: Observed, poses: Iterable[int]) -> np.ndarray:
    """Return mean squares of differences over those of second differences, less the pattern's."""
    chosen, within = list(poses), observed.within
    products, squares, counts = (
        np.sum([sums[pose] for pose in chosen], axis=0)
        for sums in (within.products, within.squares, within.counts)
    )
    pattern = observed.pattern_differences
    shared = np.array([[pattern[axis, lag].variance() for lag in LAGS] for axis in AXES])
    narrow = products - shared * counts
    wide = squares - _shared_second(observed) * counts
    return quotient(narrow, np.where(wide > LEAST_VARIANCE * counts, wide, 0.0))


def second_difference_share(width_px: float) -> float:
    """Return the share of the variance that scaled second differences of filtered noise show."""
    near, far = (neighbour_correlation(width_px, k * SPACING) for k in (1, 2))
    return (1.5 - 2.0 * near + 0.5 * far) / 1.5
