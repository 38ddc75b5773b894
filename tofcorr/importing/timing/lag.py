r"""How much later images are stamped than poses: from how strongly both change.

Where the tool moves, the depth image changes. For a lag L the movement of the tool between the
times of two images, :math:`m_k(L)`, is held against the change of the images, :math:`a_k`:

.. math:: \hat L = \arg\max_L \operatorname{corr}_k\left(a_k, m_k(L)\right)

No hand-eye transform and no plane is needed. Where images are taken at stops only, many lags
explain them alike: then no lag is assumed. `tofcorr.importing.posed.lag_refinement` refines the
result once walls are known.
"""

from dataclasses import dataclass

import numpy as np

from tofcorr.importing.poses.track import PoseTrack

_LARGEST_LAG = 1.0
"""Lags beyond this many seconds are not looked for: they are other clocks, not a delay."""

_STEP = 0.005
"""Step of the search, seconds: half of the 10 ms that matter at 0.1 m/s (1 mm)."""

_FEWEST_CHANGES = 12
"""Fewest pairs of images that a lag is estimated from: with fewer a correlation of 0.7 comes by
chance in one of a hundred lists."""

_LEAST_CORRELATION = 0.5
"""Below this correlation the images do not follow the poses, and no lag is stated. Set by hand: the
poses then explain less than a quarter of the changes."""

_AS_GOOD = 0.1
"""A lag of zero is kept if it leaves at most this share more of the changes unexplained than the
best lag. Set on simulated drives with one image a stop: there the correlation has no peak."""

_AT_ONCE = 40
"""Lags whose poses are interpolated in one go: more is not faster, and takes memory."""

_LEVER = 1.0
"""Metres that a turn of the tool by one radian counts as: the distance to the wall, about."""


@dataclass(frozen=True, kw_only=True)
class Lag:
    """An estimated lag.

    Attributes:
        seconds: Image stamps minus pose stamps; positive: images are stamped late.
        standard_error: From leaving out a tenth of the changes at a time, seconds.
        correlation: Between the changes of images and poses, at that lag.
    """

    seconds: float
    standard_error: float
    correlation: float


def known_lag(seconds: float) -> Lag:
    """Return a lag that is given and not estimated."""
    return Lag(seconds=seconds, standard_error=0.0, correlation=float("nan"))


def estimate_lag(track: PoseTrack, times: np.ndarray, change: np.ndarray) -> Lag | None:
    """Estimate the lag between images and poses.

    Args:
        track: The poses, with time stamps.
        times: Of the images, shape (I,), increasing, seconds on their own clock.
        change: How much each image differs from the one before, metres, shape (I - 1,); NaN where
            unknown.

    Returns:
        The lag; None if the images do not tell (too few, or no movement seen in them).
    """
    reach = round(_LARGEST_LAG / _STEP)
    lags = np.arange(-reach, reach + 1) * _STEP
    parts = np.array_split(lags, -(-len(lags) // _AT_ONCE))
    moved = np.concatenate([movement(track, times - part[:, None]) for part in parts])
    usable = np.isfinite(change) & np.isfinite(moved).all(axis=0)
    if usable.sum() < _FEWEST_CHANGES:
        return None
    seen, moved = change[usable], moved[:, usable]
    if seen.std() == 0 or (moved.std(axis=1) == 0).any():
        return None
    best, correlation = _best(lags, _correlations(moved, seen))
    if correlation < _LEAST_CORRELATION:
        return None
    deal = np.arange(len(seen)) * 10 // len(seen)
    left_out = [
        _best(lags, _correlations(moved[:, deal != k], seen[deal != k]))[0] for k in range(10)
    ]
    error = float(np.sqrt(9 / 10 * np.sum((np.array(left_out) - np.mean(left_out)) ** 2)))
    return Lag(seconds=best, standard_error=error, correlation=correlation)


def movement(track: PoseTrack, times: np.ndarray) -> np.ndarray:
    """Return how far the tool moves from each time to the next, metres: (L, I) to (L, I - 1)."""
    poses = track.at(times.ravel()).reshape(*times.shape, 4, 4)
    step = np.linalg.norm(np.diff(poses[..., :3, 3], axis=1), axis=2)
    turn = np.linalg.norm(poses[:, 1:, :3, :3] - poses[:, :-1, :3, :3], axis=(2, 3)) / np.sqrt(2)
    return step + _LEVER * turn


def _correlations(moved: np.ndarray, seen: np.ndarray) -> np.ndarray:
    centred = moved - moved.mean(axis=1, keepdims=True)
    seen = seen - seen.mean()
    scale = np.linalg.norm(centred, axis=1) * np.linalg.norm(seen)
    return centred @ seen / np.maximum(scale, 1e-300)


def _best(lags: np.ndarray, correlation: np.ndarray) -> tuple[float, float]:
    """Return the lag of the highest correlation, or zero if it explains as much."""
    top = float(correlation.max())
    zero = len(lags) // 2
    if 1 - correlation[zero] <= (1 + _AS_GOOD) * (1 - top):
        return 0.0, float(correlation[zero])
    # The maximum of the parabola through three points.
    k = int(np.clip(correlation.argmax(), 1, len(lags) - 2))
    left, middle, right = correlation[k - 1 : k + 2]
    bend = left - 2 * middle + right
    shift = 0.0 if bend >= 0 else 0.5 * (left - right) / bend
    return float(lags[k] + shift * _STEP), top
