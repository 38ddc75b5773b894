r"""The width of a Gaussian filter from the correlation of neighbouring pixels, and back.

White noise filtered with the weights :math:`w_k = e^{-k^2/2\sigma^2}` has the correlation
:math:`\rho_L = \sum_k w_k w_{k+L} / \sum_k w_k^2` between pixels L apart in a row or column.
"""

from collections.abc import Sequence

import numpy as np

# Widest filter considered, pixels, and how far its weights are summed, in widths: e^-18 is left.
WIDEST_PX = 5.0
_REACH = 6
# Correlation of nearest neighbours below which noise counts as white. Chosen: it changes the
# variance of a mean of nine pixels by less than 5 %.
_WHITE = 0.01
# Narrowest filter, pixels: its correlation, 2 e^-12.5 or 1e-5, is far below the one above.
_NARROWEST_PX = 0.2

# Halvings of the interval of widths: 5 px / 2^20 is below any use.
_HALVINGS = 20


def neighbour_correlation(width_px: float, lag: int) -> float:
    """Return the correlation of pixels `lag` apart after a Gaussian filter of this width.

    Args:
        width_px: Standard deviation of the filter, pixels; 0: no filter.
        lag: Distance along a row or column, pixels.
    """
    if width_px <= 0:
        return float(lag == 0)
    reach = int(np.ceil(_REACH * width_px)) + lag
    weights = np.exp(-0.5 * (np.arange(-reach, reach + 1) / width_px) ** 2)
    shifted = weights[: len(weights) - lag] @ weights[lag:]
    return float(shifted / (weights @ weights))


def filter_width(correlations: Sequence[float]) -> float:
    """Return the width of the filter that gives these correlations.

    The sum of the correlations is matched, because it decides how far averaging reduces noise.

    Args:
        correlations: At lags 1, 2, ...: means over rows and columns.

    Returns:
        Standard deviation, pixels, 0 to 5; 0 if nearest neighbours correlate by less than 0.01,
        or if that is unknown.
    """
    wanted = float(np.sum(correlations))
    if not np.isfinite(wanted):
        return 0.0
    if not correlations[0] > _WHITE or not wanted > _WHITE:
        return 0.0
    lags = range(1, len(correlations) + 1)

    def excess(width: float) -> float:
        return sum(neighbour_correlation(width, lag) for lag in lags) - wanted

    if excess(WIDEST_PX) <= 0:
        return WIDEST_PX
    if excess(_NARROWEST_PX) >= 0:
        return 0.0
    low, high = _NARROWEST_PX, WIDEST_PX
    for _ in range(_HALVINGS):
        middle = (low + high) / 2
        low, high = (low, middle) if excess(middle) > 0 else (middle, high)
    return (low + high) / 2
