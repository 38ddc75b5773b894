"""Means over splits with their intervals, and paired tests between models of the same splits."""

import math
from dataclasses import dataclass

import numpy as np

from tofcorr.estimation.student import student_quantile, student_tail

CONFIDENCE = 0.95
"""Confidence level of every interval and test of an evaluation; the paper's own."""


@dataclass(frozen=True)
class Estimate:
    """A mean over splits.

    Attributes:
        mean: The mean.
        half_width: Half the 95 % interval, of Student's t.
        standard_deviation: Of the splits' values.
        p_value: Two-sided, of the hypothesis that the true mean is zero.
        degrees_of_freedom: Splits minus one.
    """

    mean: float
    half_width: float
    standard_deviation: float
    p_value: float
    degrees_of_freedom: int

    @property
    def significant(self) -> bool:
        """Whether the interval excludes zero."""
        return self.p_value < 1 - CONFIDENCE


def over_folds(values: np.ndarray) -> Estimate:
    """Return mean and interval over the folds of a cross-validation; for six folds, 2.57 SE."""
    return _estimate(values, 1 / len(values))


def over_repeats(values: np.ndarray, test_fraction: float) -> Estimate:
    """Return mean and interval over random splits of the same frames.

    Such splits share most of their training frames, so they are not independent. Their variance is
    enlarged by n_test / n_train (Nadeau and Bengio 2003, the corrected resampled t-test).
    """
    return _estimate(values, 1 / len(values) + test_fraction / (1 - test_fraction))


def _estimate(values: np.ndarray, variance_factor: float) -> Estimate:
    dof = len(values) - 1
    deviation = float(np.std(values, ddof=1)) if dof else math.nan
    mean, error = float(np.mean(values)), deviation * math.sqrt(variance_factor)
    if not dof:
        return Estimate(mean, math.nan, math.nan, math.nan, 0)
    half_width = student_quantile((1 + CONFIDENCE) / 2, dof) * error
    # Two columns that are equal in every split have no difference to test.
    p_value = 2 * student_tail(abs(mean) / error, dof) if error > 0 else float(mean == 0)
    return Estimate(mean, half_width, deviation, p_value, dof)
