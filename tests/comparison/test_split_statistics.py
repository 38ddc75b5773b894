"""Intervals and tests over splits are those of the textbook."""

import math

import numpy as np
import pytest
from scipy import stats

from tofcorr.comparison.statistics import Estimate


def test_intervals_and_p_values_are_those_of_students_t() -> None:
    first, second = np.array([5.0, 7, 6, 9, 4, 8]), np.array([4.0, 6.5, 6, 7, 4.2, 6])
    found = Estimate(first - second)
    expected = stats.ttest_rel(first, second)
    assert found.p_value == pytest.approx(expected.pvalue)
    interval = expected.confidence_interval(0.95)
    assert found.mean - found.half_width == pytest.approx(interval.low)
    assert found.mean + found.half_width == pytest.approx(interval.high)
    # The paper's 2.57 standard errors are the t quantile of six folds.
    standard_error = np.std(first - second, ddof=1) / math.sqrt(6)
    assert found.half_width == pytest.approx(2.5706 * standard_error, rel=1e-4)


def test_overlapping_splits_get_wider_intervals_than_folds() -> None:
    values = np.array([3.0, 4, 5, 4, 3, 5])
    folds, repeats = Estimate(values), Estimate(values, 0.25 / 0.75)
    # n_test / n_train = 1/3 is added to 1/6.
    assert repeats.half_width == pytest.approx(folds.half_width * math.sqrt(3.0))
    assert repeats.mean == folds.mean


def test_equal_columns_do_not_differ_and_one_split_has_no_interval() -> None:
    same = Estimate(np.zeros(6))
    assert (same.mean, same.p_value, same.significant) == (0.0, 1.0, False)
    single = Estimate(np.array([3.0]))
    assert single.mean == 3.0
    assert math.isnan(single.half_width)
    assert not single.significant
