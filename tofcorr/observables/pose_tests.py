"""Intervals and p-values with poses as the unit: pixels of an image are no independent samples."""

from collections.abc import Callable

import numpy as np

# Resamples of the poses for an interval, and permutations for a p-value: they resolve 1/1000. As
# many as are usual.
_DRAWS = 999
LEAST_P = 1 / (_DRAWS + 1)
"""The smallest p-value that the draws can give. Derived: the data count as one draw more."""
LEAST_POSES = 6
"""Fewest poses for which anything is tested: five signs allow 32 flips, p-values of 0.06."""

Interval = tuple[float, float]


def bootstrap(
    draw: Callable[[np.random.Generator], float], num_poses: int, random: np.random.Generator
) -> Interval | None:
    """Return the 95 % percentile interval of a statistic of resampled poses.

    Args:
        draw: Resamples the poses and returns the statistic.
        num_poses: Number of poses of the smaller recording.
        random: Source of the resamples.

    Returns:
        None with fewer than six poses, or where the statistic is not finite in most resamples.
    """
    if num_poses < LEAST_POSES:
        return None
    drawn = np.array([draw(random) for _ in range(_DRAWS)])
    drawn = drawn[np.isfinite(drawn)]
    if len(drawn) < _DRAWS / 2:
        return None
    low, high = np.quantile(drawn, (0.025, 0.975))
    return float(low), float(high)


def sign_flip_p(differences: np.ndarray, random: np.random.Generator) -> float | None:
    """Return the two-sided p-value of paired differences having a mean of zero.

    Under the null, real and simulated could be swapped in every pose.

    Args:
        differences: Of each pose, shape (P,); NaN is left out.
        random: Source of the signs.
    """
    known = differences[np.isfinite(differences)]
    if len(known) < LEAST_POSES:
        return None
    signs = random.choice((-1.0, 1.0), size=(_DRAWS, len(known)))
    return _share_beyond(np.abs(signs @ known), abs(float(known.sum())))


def permutation_p(real: np.ndarray, sim: np.ndarray, random: np.random.Generator) -> float | None:
    """Return the two-sided p-value of two samples of poses having the same mean.

    Args:
        real: Of each real pose, shape (P,); NaN is left out.
        sim: Of each simulated pose, shape (Q,); NaN is left out.
        random: Source of the permutations.
    """
    real, sim = real[np.isfinite(real)], sim[np.isfinite(sim)]
    if min(len(real), len(sim)) < LEAST_POSES:
        return None
    both = np.concatenate([real, sim])
    flags = np.zeros((_DRAWS, len(both)))
    flags[:, : len(real)] = 1.0
    flags = random.permuted(flags, axis=1)
    share = 1.0 / len(real) + 1.0 / len(sim)
    drawn = np.abs(flags @ both * share - both.sum() / len(sim))
    return _share_beyond(drawn, abs(float(real.mean() - sim.mean())))


def _share_beyond(drawn: np.ndarray, observed: float) -> float:
    # The observed order is one of the possible ones. Equal values differ by rounding.
    return float((1 + (drawn >= observed * (1 - 1e-9)).sum()) / (len(drawn) + 1))
