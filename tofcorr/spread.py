"""The standard deviation of mostly normal values, from their median absolute deviation."""

from typing import TYPE_CHECKING, TypeVar

if TYPE_CHECKING:
    import numpy as np
    from torch import Tensor

    SpreadT = TypeVar("SpreadT", float, np.floating, np.ndarray, Tensor)
else:
    SpreadT = TypeVar("SpreadT")

# 1 / Phi^-1(3/4): half of a normal distribution lies within 0.6745 standard deviations.
_SIGMA_PER_MAD = 1.482602218505602


def sigma_from_mad(median_absolute_deviation: SpreadT) -> SpreadT:
    """Return the standard deviation of a normal distribution of this median absolute deviation.

    Gross outliers hardly change a median, so the result is that of the bulk of the values.

    Args:
        median_absolute_deviation: A number, an array or a tensor, in any unit.

    Returns:
        1.4826 times it, in the same unit.

    Example:
        >>> round(sigma_from_mad(2.0), 4)
        2.9652
    """
    return _SIGMA_PER_MAD * median_absolute_deviation
