"""Errors over a covariate, in bins."""

from typing import NamedTuple

import numpy as np

# Bins of a covariate. Set by hand.
_BINS = 30
# Bins of fewer pixels are left out: their mean is mostly noise. Set by hand.
_FEWEST_PIXELS = 30
# Share of a covariate's values left out at either end of the axis. Set by hand.
_ENDS = 0.001


class Profile(NamedTuple):
    """Middle of each bin, and mean and standard deviation of the errors in it, (bins,) each."""

    middle: np.ndarray
    mean: np.ndarray
    spread: np.ndarray


def profile(x: np.ndarray, error: np.ndarray, ends: tuple[float, float] | None = None) -> Profile:
    """Return mean and standard deviation of an error over a covariate.

    Args:
        x: The covariate, shape (M,).
        error: The error of each pixel, shape (M,); NaN is left out.
        ends: Range of the covariate; its central 99.8 % if None.
    """
    edges = np.linspace(*(ends or ends_of(x)), _BINS + 1)
    number = np.digitize(x, edges) - 1
    inside = (number >= 0) & (number < len(edges) - 1) & np.isfinite(error)
    count, total, square = (
        np.bincount(number[inside], weights, len(edges) - 1)
        for weights in (None, error[inside], error[inside] ** 2)
    )
    enough = count >= _FEWEST_PIXELS
    mean = total[enough] / count[enough]
    spread = np.sqrt(np.maximum(square[enough] / count[enough] - mean**2, 0))
    return Profile(((edges[1:] + edges[:-1]) / 2)[enough], mean, spread)


def ends_of(x: np.ndarray) -> tuple[float, float]:
    """Return the range of the central 99.8 % of a covariate."""
    low, high = np.quantile(x, [_ENDS, 1 - _ENDS])
    return float(low), float(high)
