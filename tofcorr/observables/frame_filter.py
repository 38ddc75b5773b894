r"""How far successive frames share their noise: a camera that averages frames filters in time.

A frame of such a camera is :math:`n_t = \rho n_{t-1} + \sqrt{1 - \rho^2}\, e_t`. Frames k apart
differ by :math:`\sigma^2 (1 - \rho^k)` in half squares, so that those of two steps are
:math:`1 + \rho` times those of one, whatever the noise is.
"""

from typing import NamedTuple

import numpy as np

# Standard errors that the correlation must exceed to be counted. Chosen: one camera in 700 without
# a filter gets one.
_LEAST_ERRORS = 3.0
# Sides of the tiles whose scatter gives the standard error, pixels. Chosen: filters of the image
# reach less far.
_TILE = 8
# Largest correlation considered (no unit). Chosen: the variance of a frame is corrected by the
# inverse of what is left.
_MOST = 0.95


class FrameCorrelation(NamedTuple):
    """Correlation of successive frames, and its standard error; NaN where nothing is known."""

    value: float
    error: float


def tiles_of(used: np.ndarray) -> np.ndarray:
    """Return the number of the tile of each used pixel of an image, (N,), of `used` (H, W)."""
    row, column = np.nonzero(used)
    return row // _TILE * (used.shape[1] // _TILE + 1) + column // _TILE


def frame_differences(residual: np.ndarray) -> np.ndarray:
    """Return half the squared differences of frames one and two apart, summed over tiles, m^2.

    Args:
        residual: Frames of one pose, shape (R, H, W), metres; NaN where unknown.

    Returns:
        Shape (2, T), of the pixels known in all frames; T is 0 with fewer than three frames.
    """
    known = np.asarray(np.isfinite(residual).all(axis=0))
    if len(residual) < 3:
        return np.zeros((2, 0))
    values, tile = residual[:, known], tiles_of(known)
    return np.stack(
        [np.bincount(tile, ((values[lag:] - values[:-lag]) ** 2).mean(0) / 2) for lag in (1, 2)]
    )


def frame_correlation(differences: np.ndarray) -> FrameCorrelation:
    """Return the correlation of successive frames by what `frame_differences` returned, (2, T).

    It is not bounded; the standard error is that by the scatter of tiles.
    """
    near, far = differences
    tiles = np.count_nonzero(near)
    if tiles < 2:
        # Frames that are equal, as where depth is rounded, show no filter.
        value = 0.0 if near.size and not tiles else np.nan
        return FrameCorrelation(value, value)
    ratio = far.sum() / near.sum()
    spread = (far - ratio * near) / near.sum()
    error = np.sqrt((spread**2).sum() * tiles / (tiles - 1))
    return FrameCorrelation(float(ratio - 1.0), float(error))


def significant_correlation(differences: np.ndarray) -> float:
    """Return the same, 0 if it is not significant, from 0 to 0.95."""
    found = frame_correlation(differences)
    return min(found.value, _MOST) if found.value > _LEAST_ERRORS * found.error else 0.0


def shown_by_repeats(correlation: float, repeats: np.ndarray) -> np.ndarray:
    """Return which share of a frame's variance the variance over repeated frames shows.

    Args:
        correlation: Of successive frames.
        repeats: Numbers of frames, any shape, int.
    """
    most = int(repeats.max(initial=0))
    shown = [1.0 - mean_correlation(correlation, count) for count in range(most + 1)]
    return np.array(shown)[repeats]


def mean_correlation(correlation: float, count: int) -> float:
    """Return the mean correlation of all pairs among successive frames; 0 of less than two.

    Args:
        correlation: Of two successive frames; of k apart it is that to the power of k.
        count: Number of frames.
    """
    if count < 2:
        return 0.0
    lags = np.arange(1, count)
    return float(((count - lags) * correlation**lags).sum() / (count - lags).sum())
