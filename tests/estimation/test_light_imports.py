"""What replaces a library that is slow to import gives what that library gives."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy import optimize, stats

from tofcorr.estimation.nonnegative import nonnegative_least_squares
from tofcorr.estimation.optimisers import uncompiled
from tofcorr.estimation.statistics import student_quantile, student_tail


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


def test_nonnegative_least_squares_are_those_of_lawson_and_hanson() -> None:
    generator = np.random.default_rng(2)
    for _ in range(50):
        columns, target = generator.normal(size=(9, 3)), generator.normal(size=9)
        found = nonnegative_least_squares(columns, target)
        np.testing.assert_allclose(found, optimize.nnls(columns, target)[0], atol=1e-12)


@pytest.mark.parametrize("kind", [torch.optim.LBFGS, torch.optim.AdamW])
def test_an_uncompiled_optimiser_takes_the_same_steps(kind: type[torch.optim.Optimizer]) -> None:
    ends = []
    for chosen in (kind, uncompiled(kind)):
        x = torch.tensor([-1.2, 1.0], dtype=torch.float64, requires_grad=True)
        optimiser = chosen([x])  # type: ignore[call-arg]

        def closure(
            x: torch.Tensor = x, optimiser: torch.optim.Optimizer = optimiser
        ) -> torch.Tensor:
            optimiser.zero_grad()
            loss = (1 - x[0]) ** 2 + 100 * (x[1] - x[0] ** 2) ** 2
            loss.backward()
            return loss

        for _ in range(5):
            optimiser.step(closure)  # type: ignore[arg-type]
        ends.append(x.detach())
    assert torch.equal(*ends)


def test_a_fit_imports_neither_the_compiler_nor_scipy_stats_nor_matplotlib() -> None:
    code = (
        "import sys, torch; from tofcorr.estimation.optimisers import uncompiled; "
        "import tofcorr.training.run, tofcorr.drift.check; "
        "x = torch.zeros(2, requires_grad=True); uncompiled(torch.optim.LBFGS)([x]).zero_grad(); "
        "x.sum().backward(); uncompiled(torch.optim.AdamW)([x]).step(); "
        "slow = {'torch._dynamo', 'scipy.stats', 'scipy.optimize', 'matplotlib'}; "
        "slow &= set(sys.modules); "
        "assert not slow, slow"
    )
    subprocess.run([sys.executable, "-c", code], check=True, cwd=Path(__file__).parents[2])
