"""Whether images follow the poses seconds late or early: two clocks, or lists that do not belong.

`tofcorr.importing.timing.lag` looks for delays; this looks farther, where walls do not fit.
"""

import numpy as np

from tofcorr.importing.poses.track import PoseTrack
from tofcorr.importing.timing.lag import movement

_FARTHEST = 30.0
"""Lags up to this many seconds are looked for. Set by hand: clocks farther apart share no stops."""

_STEP = 0.1
"""Step of the search, seconds: a tenth of what the estimate of a delay then covers."""

_MOST = 12
"""Lags that are proposed at most. Set by hand: each costs a search for walls."""

_APART = 0.5
"""Seconds between two lags that are proposed: less than a stop and a move take."""

_LEAST_SHARE = 0.75
"""Share of the images that must have a pose at the lag, so that a few at an end do not decide."""


def far_lags(track: PoseTrack, times: np.ndarray, change: np.ndarray) -> list[float]:
    """Propose lags far beyond a delay, seconds, those that the images follow best first.

    A robot that stops at equal times makes many lags alike; walls decide among them. The root of
    movements and changes counts, so that a few large ones do not.

    Args:
        track: The poses, with time stamps.
        times: Of the images, shape (I,), increasing, seconds on their own clock.
        change: How much each image differs from the one before, metres, shape (I - 1,); NaN where
            unknown.
    """
    lags = np.arange(-_FARTHEST, _FARTHEST + _STEP, _STEP)
    root = np.sqrt(change)
    follows = np.array(
        [_correlation(np.sqrt(movement(track, times[None] - lag)[0]), root) for lag in lags]
    )
    found: list[float] = []
    for k in np.argsort(-follows):
        if len(found) == _MOST or follows[k] <= 0:
            break
        if all(abs(lags[k] - other) >= _APART for other in (0.0, *found)):
            found.append(float(lags[k]))
    return found


def _correlation(moved: np.ndarray, change: np.ndarray) -> float:
    """Return the correlation of two lists (I - 1,) where both are known; 0 if that is little."""
    both = np.isfinite(moved) & np.isfinite(change)
    if both.sum() < max(2.0, _LEAST_SHARE * len(change)):
        return 0.0
    moved, change = moved[both], change[both]
    if moved.std() == 0 or change.std() == 0:
        return 0.0
    return float(np.corrcoef(moved, change)[0, 1])
