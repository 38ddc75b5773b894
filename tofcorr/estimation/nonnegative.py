"""Least squares with coefficients that are not negative, for a handful of them."""

from itertools import combinations

import numpy as np


def nonnegative_least_squares(columns: np.ndarray, target: np.ndarray) -> np.ndarray:
    """Return the x >= 0 that minimises |columns x - target|.

    The solution is the ordinary one of the columns whose coefficients are not zero, so that all
    choices of columns are tried: for three columns quicker than importing a solver, and exact.

    Args:
        columns: Shape (M, K), K of a few.
        target: Shape (M,).

    Returns:
        Shape (K,).
    """
    size = columns.shape[1]
    best, least = np.zeros(size), float(target @ target)
    for number in range(1, size + 1):
        for chosen in combinations(range(size), number):
            picked = columns[:, chosen]
            found = np.linalg.lstsq(picked, target, rcond=None)[0]
            loss = float(np.sum((picked @ found - target) ** 2))
            if (found >= 0).all() and loss < least:
                best, least = np.zeros(size), loss
                best[list(chosen)] = found
    return best
