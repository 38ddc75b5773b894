"""A table of a smooth function gives its values, or the function does where no table would pay."""

import pytest
import torch
from torch import Tensor

from tofcorr.simulation.effects.numerics import interpolated


def test_a_table_is_right_to_an_eighth_of_the_squared_step() -> None:
    at = 6 * torch.rand(200, 300, generator=torch.Generator().manual_seed(1)) - 3
    calls = []

    def sine(x: Tensor) -> Tensor:
        calls.append(x.numel())
        return torch.sin(x)

    # The second derivative is at most 1; rounding of float32 adds 1e-7 for each operation.
    error = (interpolated(sine, at, 0.01) - torch.sin(at.double())).abs()
    assert float(error.max()) < 0.01**2 / 8 + 1e-6
    assert max(calls) < 700


def test_missing_values_stay_missing_and_both_ends_are_known() -> None:
    at = torch.linspace(0, 7, 70_000)
    at[2::5] = torch.nan
    found = interpolated(torch.square, at, 0.125)
    assert torch.equal(found.isnan(), at.isnan())
    assert float(found[1]) == pytest.approx(1e-4 * 0.125, rel=0.01)
    assert float(found[-1]) == pytest.approx(49.0, abs=1e-5)


@pytest.mark.parametrize("at", [torch.rand(1000).double(), torch.rand(20), torch.zeros(0)])
def test_few_and_precise_values_are_computed_one_by_one(at: Tensor) -> None:
    assert torch.equal(interpolated(torch.exp, at, 0.01), torch.exp(at))


def test_derivatives_are_those_of_the_function() -> None:
    at = torch.rand(10_000).requires_grad_()
    (slope,) = torch.autograd.grad(interpolated(torch.sin, at, 0.01).sum(), at)
    torch.testing.assert_close(slope, torch.cos(at.detach()))
