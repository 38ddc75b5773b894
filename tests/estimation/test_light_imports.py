"""What replaces a library that is slow to import gives what that library gives."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from scipy import stats

from tofcorr.estimation.robust import student_quantile, student_tail


@pytest.mark.parametrize("degrees_of_freedom", [1, 2, 5.5, 39, 399, 401, 1e4, 1e7])
def test_student_is_that_of_scipy(degrees_of_freedom: float) -> None:
    for probability in (0.001, 0.5, 0.95, 0.975, 0.9999):
        expected = stats.t.isf(1 - probability, degrees_of_freedom)
        assert student_quantile(probability, degrees_of_freedom) == pytest.approx(
            expected, rel=1e-10
        )
    for value in (-3.0, 0.0, 0.5, 12.0, np.inf):
        expected = stats.t.sf(value, degrees_of_freedom)
        assert student_tail(value, degrees_of_freedom) == pytest.approx(expected, rel=1e-10)


def test_student_without_a_degree_of_freedom_is_not_a_number() -> None:
    assert np.isnan(student_quantile(0.975, 0))
    assert np.isnan(student_tail(1.0, 0))


def test_a_fit_imports_neither_the_compiler_nor_scipy_stats_nor_matplotlib() -> None:
    code = (
        "import sys; import tofcorr.training.run, tofcorr.drift.check; "
        "slow = {'torch._dynamo', 'scipy.stats', 'scipy.optimize', 'matplotlib'}; "
        "slow &= set(sys.modules); "
        "assert not slow, slow"
    )
    subprocess.run([sys.executable, "-c", code], check=True, cwd=Path(__file__).parents[2])
