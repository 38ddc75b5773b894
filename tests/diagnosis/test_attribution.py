"""The shares of the causes in the square of the gap: laws of a Shapley value."""

import itertools
import math

import pytest
import torch
from torch import Tensor

from tofcorr.diagnosis.findings.attribution import scaled_shares, shapley_values
from tofcorr.diagnosis.findings.causes import Cause
from tofcorr.diagnosis.findings.parts import Parts, Refitted
from tofcorr.diagnosis.report.result import DiagnosisResult


def _toy(seed: int, causes: int = 4, size: int = 60) -> tuple[Tensor, Tensor]:
    """Return parts (size, causes) and a residual that is their sum and something else."""
    generator = torch.Generator().manual_seed(seed)
    parts = torch.randn(size, causes, generator=generator, dtype=torch.float64)
    parts = parts + parts[:, :1]
    rest = torch.randn(size, generator=generator, dtype=torch.float64)
    return parts, parts.sum(1) + 0.3 * rest


def _values(parts: Tensor, residual: Tensor) -> Tensor:
    everything = torch.cat([parts, residual[:, None]], dim=1)
    return shapley_values(everything.T @ everything, torch.eye(parts.shape[1]).double())


def _worth(parts: Tensor, residual: Tensor, chosen: tuple[int, ...]) -> float:
    left = residual - parts[:, list(chosen)].sum(1)
    return float((residual**2).sum() - (left**2).sum())


@pytest.mark.parametrize("seed", [1, 2])
def test_a_share_is_the_mean_increment_over_all_orders(seed: int) -> None:
    parts, residual = _toy(seed)
    count = parts.shape[1]
    expected = torch.zeros(count, dtype=torch.float64)
    for order in itertools.permutations(range(count)):
        for place, cause in enumerate(order):
            before, after = order[:place], order[: place + 1]
            expected[cause] += _worth(parts, residual, after) - _worth(parts, residual, before)
    expected /= math.factorial(count)
    assert torch.allclose(_values(parts, residual), expected, rtol=1e-10)


def test_shares_of_all_causes_add_up_to_what_they_close() -> None:
    parts, residual = _toy(3)
    whole = _worth(parts, residual, tuple(range(parts.shape[1])))
    assert float(_values(parts, residual).sum()) == pytest.approx(whole)


def test_orthogonal_parts_get_their_own_squares() -> None:
    generator = torch.Generator().manual_seed(5)
    basis, _ = torch.linalg.qr(torch.randn(50, 4, generator=generator, dtype=torch.float64))
    parts = basis[:, :3] * torch.tensor([3.0, 2.0, 1.0])
    residual = parts.sum(1) + 0.5 * basis[:, 3]
    assert torch.allclose(_values(parts, residual), torch.tensor([9.0, 4.0, 1.0]).double())


def test_the_order_of_causes_does_not_matter() -> None:
    parts, residual = _toy(6)
    order = torch.tensor([2, 0, 3, 1])
    assert torch.allclose(_values(parts[:, order], residual), _values(parts, residual)[order])


def _two_parts(first: float, second: float) -> Refitted:
    """Return two orthogonal parts of unit size with these Shapley values."""
    products = torch.eye(3).double()
    products[:2, 2] = products[2, :2] = torch.tensor([first + 1, second + 1]).double() / 2
    return Refitted(
        products=products, means=torch.zeros(3).double(), coefficients=torch.eye(2).double()
    )


def test_shares_of_parts_that_help_are_in_proportion_to_them() -> None:
    shares, _ = scaled_shares(_two_parts(3.0, 1.0), total=2.5, left=1.5)
    assert torch.allclose(shares, torch.tensor([0.48, 0.16, 0.36]).double())


def test_parts_that_cancel_share_what_is_explained_held_out() -> None:
    """In the fit they explain less than nothing; each was given a share of 0 %, up to 2553 %."""
    shares, _ = scaled_shares(_two_parts(1.6, -1.98), total=2.07, left=0.74)
    assert float(shares.sum()) == pytest.approx(1.0)
    assert float(shares[2]) == pytest.approx((0.74 / 2.07) ** 2)
    assert float(shares[0]) > 0.7
    assert 0 < float(shares[1]) < 0.2


def test_an_effect_that_the_base_model_absorbs_explains_what_it_closes() -> None:
    generator = torch.Generator().manual_seed(8)
    base = torch.randn(400, 3, generator=generator, dtype=torch.float64)
    effect = base @ torch.ones(3, 1).double() + 0.3 * torch.randn(
        400, 1, generator=generator, dtype=torch.float64
    )
    error = 5 * effect[:, 0] + 0.1 * torch.randn(400, generator=generator, dtype=torch.float64)
    residual = error - base @ torch.linalg.lstsq(base, error).solution
    columns = torch.cat([base, effect], 1)
    everything = torch.cat([columns, residual[:, None]], 1)
    parts = Parts(
        causes=(Cause(name="wiggling", kind="effect", members=(3,)),),
        products=(everything.T @ everything)[None],
        means=everything.sum(0)[None],
        counts=torch.tensor([400.0]).double(),
        noise=torch.zeros(1).double(),
        start=torch.zeros(4).double(),
        fitted=(
            (columns.T @ columns)[None],
            (columns.T @ residual)[None],
            torch.zeros(4, 4).double(),
        ),
        constant=0,
        least={},
    )
    left = residual - columns @ torch.linalg.lstsq(columns, residual).solution
    refitted = parts.refitted(torch.ones(1).double())
    explained = shapley_values(refitted.products, refitted.coefficients)
    closed = residual.square().mean() - left.square().mean()
    assert torch.allclose(explained.sum(), closed, rtol=1e-9)


def test_without_a_simulator_nothing_is_as_given_and_shares_are_of_the_fitted_one(
    time_diagnosis: DiagnosisResult,
) -> None:
    found = time_diagnosis.to_mapping()
    assert found["version"] == 2
    assert found["simulator"] == "fitted"
    names = ["as_given", "recalibrated", "with_effects"]
    assert [stage["name"] for stage in found["stages"]] == names
    assert found["stages"][0]["gap_mm"] is None
    assert found["stages"][1]["gap_mm"] == found["gap_mm"]["before"]
    assert found["parameter_gap_mm"]["as_given"] is None
    shares = {entry["cause"]: entry["share"] for entry in found["attribution"]}
    assert set(shares) == {"integration_time", "unexplained"}
    assert sum(shares.values()) == pytest.approx(1.0, abs=1e-3)
    gap = found["gap_mm"]
    closed = 1 - (gap["after"] / gap["before"]) ** 2
    assert shares["integration_time"] == pytest.approx(closed, abs=1e-3)
    assert closed > 0.9
    assert found["verdict"].startswith("No simulator was given")
