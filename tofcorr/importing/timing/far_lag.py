"""Whether images follow the poses seconds late or early: two clocks, or lists that do not belong.

`tofcorr.importing.timing.lag` looks for delays; this looks farther, where walls do not fit.
"""

import numpy as np

from tofcorr.importing.poses.track import PoseTrack
from tofcorr.importing.timing.lag import Lag, movement

_FARTHEST = 30.0
"""Lags up to this many seconds are looked for. Set by hand: clocks farther apart share no stops."""

_STEP = 0.1
"""Step of the search, seconds: a tenth of what the estimate of a delay then covers."""

_LEAST_CORRELATION = 0.7
"""Least correlation between the changes of images and poses: by chance it comes in one of a hundred
lists of twelve, and lists are longer."""

_FAR_BETTER = 0.5
"""A far lag must leave at most this share of the changes unexplained that the lag assumed leaves.
Set by hand: stops at equal times make other lags fit almost as well."""

_LEAST_SHARE = 0.5
"""Share of the images that must have a pose at the lag, so that a few at an end do not decide."""


def far_lag(track: PoseTrack, times: np.ndarray, change: np.ndarray, assumed: float) -> Lag | None:
    """Find a lag far beyond a delay under which the images follow the poses.

    Args:
        track: The poses, with time stamps.
        times: Of the images, shape (I,), increasing, seconds on their own clock.
        change: How much each image differs from the one before, metres, shape (I - 1,); NaN where
            unknown.
        assumed: The lag under which walls do not fit, seconds.

    Returns:
        The lag; None if none explains the images far better than the one assumed.
    """
    lags = np.append(np.arange(-_FARTHEST, _FARTHEST + _STEP, _STEP), assumed)
    found = np.array([_correlation(movement(track, times[None] - lag)[0], change) for lag in lags])
    best = int(found.argmax())
    if found[best] < _LEAST_CORRELATION or 1 - found[best] > _FAR_BETTER * (1 - found[-1]):
        return None
    return Lag(seconds=float(lags[best]), standard_error=_STEP, correlation=float(found[best]))


def _correlation(moved: np.ndarray, change: np.ndarray) -> float:
    """Return the correlation of two lists (I - 1,) where both are known; 0 if that is little."""
    both = np.isfinite(moved) & np.isfinite(change)
    if both.sum() < max(2.0, _LEAST_SHARE * len(change)):
        return 0.0
    moved, change = moved[both], change[both]
    if moved.std() == 0 or change.std() == 0:
        return 0.0
    return float(np.corrcoef(moved, change)[0, 1])
