"""Time stamps in seconds, whatever unit since 1970 they were written in."""

import numpy as np

_UNITS = ((1e17, 1e-9), (1e14, 1e-6), (1e11, 1e-3))
"""From this number on a stamp counts nanoseconds, microseconds or milliseconds, and the factor to
seconds. In seconds the least of them is the year 5138; in its own unit each is 1973."""


def in_seconds(stamps: np.ndarray) -> np.ndarray:
    """Return time stamps in seconds, shape (N,).

    Args:
        stamps: In seconds; or in milliseconds, microseconds or nanoseconds since 1970, which are
            told by their size. All are in one unit.

    Example:
        >>> in_seconds(np.array([1_700_000_000_500_000_000])).tolist()
        [1700000000.5]
    """
    least = float(stamps.min()) if len(stamps) else 0.0
    return stamps * next((factor for bound, factor in _UNITS if least >= bound), 1.0)
