"""Means of held-out errors with their intervals, paired comparisons, and the ranking of models."""

from collections.abc import Mapping
from dataclasses import dataclass
from math import isfinite, nan, sqrt

import numpy as np

from tofcorr.estimation.robust import student_quantile, student_tail

CONFIDENCE = 0.95
"""Confidence level of every interval and test of a comparison; the usual convention."""


@dataclass(frozen=True)
class Estimate:
    """A mean.

    Attributes:
        mean: The mean.
        standard_deviation: Of the values; as all below NaN for a single value.
        standard_error: Of the mean.
        half_width: Half the 95 % interval, of Student's t.
        p_value: Two-sided, of the hypothesis that the true mean is zero.
        degrees_of_freedom: Values minus one.
    """

    mean: float
    standard_deviation: float
    standard_error: float
    half_width: float
    p_value: float
    degrees_of_freedom: int

    @property
    def significant(self) -> bool:
        """Whether the interval excludes zero."""
        return self.p_value < 1 - CONFIDENCE

    @property
    def interval(self) -> tuple[float, float]:
        """The 95 % interval."""
        return self.mean - self.half_width, self.mean + self.half_width


def estimate(values: np.ndarray, overlap: float = 0.0) -> Estimate:
    """Return the mean of values with its interval.

    Splits of the same frames share most of their training frames, so their errors are not
    independent: the variance of the mean is enlarged (Nadeau and Bengio 2003, the corrected
    resampled t-test).

    Args:
        values: Shape (N,); for six folds the half width is 2.57 standard errors.
        overlap: By how many variances of one value; n_test / n_train for random splits.
    """
    mean, dof = float(np.mean(values)), len(values) - 1
    if not dof:
        return Estimate(mean, nan, nan, nan, nan, 0)
    deviation = float(np.std(values, ddof=1))
    error = deviation * sqrt(1 / len(values) + overlap)
    # Two columns that are equal in every split have no difference to test.
    p_value = 2 * student_tail(abs(mean) / error, dof) if error > 0 else float(mean == 0)
    half_width = student_quantile((1 + CONFIDENCE) / 2, dof) * error
    return Estimate(mean, deviation, error, half_width, p_value, dof)


@dataclass(frozen=True)
class Ranking:
    """The models of one cross-validation.

    Attributes:
        errors: Each model's held-out error over the poses, millimetres, in the order given.
        behind: Each model's error minus that of the best, pose by pose, millimetres.
        complexity: Number of unknowns of each model.
        best: The model of the smallest held-out error.
        winner: The simplest model within one standard error of the best.
        ties: Models whose 95 % interval of the difference to the winner contains zero.
    """

    errors: dict[str, Estimate]
    behind: dict[str, Estimate]
    complexity: Mapping[str, int]
    best: str
    winner: str
    ties: list[str]


def rank(errors: Mapping[str, np.ndarray], complexity: Mapping[str, int], groups: int) -> Ranking:
    """Compare models on poses that they were not fitted to.

    Poses held out together share a fit, and fits share most of their poses; so the variance of a
    mean over N poses is taken as s^2 / N (1 + K / (K - 1)) with K groups held out in turn, the
    correction of Nadeau and Bengio (2003) for one pose's share. The one-standard-error rule
    (Breiman et al. 1984) is applied to the paired difference, whose standard error is much smaller
    than that of either error: easy images are easy for all models.

    The order of the models does not matter: equal errors are ranked by complexity, then by name.

    Args:
        errors: Each model's held-out error of each pose, shape (N,), in the same order of poses.
        complexity: Number of unknowns of each model.
        groups: K.
    """

    def paired(values: np.ndarray) -> Estimate:
        return estimate(values, groups / (groups - 1) / len(values))

    own = {name: paired(values) for name, values in errors.items()}
    best = min(errors, key=lambda name: (own[name].mean, complexity[name], name))
    behind = {name: paired(values - errors[best]) for name, values in errors.items()}
    # Of a single pose no standard error is known: then all are near, and all tie.
    near = [name for name, one in behind.items() if not one.mean > one.standard_error]
    winner = min(near, key=lambda name: (complexity[name], own[name].mean, name))
    differences = {name: paired(values - errors[winner]) for name, values in errors.items()}
    ties = [
        name
        for name, one in differences.items()
        if name != winner and not abs(one.mean) > one.half_width
    ]
    return Ranking(own, behind, complexity, best, winner, ties)


def or_none(value: float) -> float | None:
    """Return None for what JSON does not have: NaN and infinity."""
    return value if isfinite(value) else None
