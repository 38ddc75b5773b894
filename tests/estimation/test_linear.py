"""Further unknowns beside an estimate: what least squares with and without them gives."""

import pytest
import torch
from optional import present
from scipy.stats import t
from torch import Generator

from tofcorr.estimation.linear import (
    AddedColumns,
    Curvature,
    NormalEquations,
    unbiased_covariance,
)

POSES, PIXELS, OWN, FURTHER = 24, 30, 4, 3


def _columns(
    generator: Generator, share: float, per_pose: float
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Return columns of known and further unknowns, and residuals: (G, M, P), (G, M, F), (G, M)."""

    def draw(*size: int) -> torch.Tensor:
        return torch.randn(*size, generator=generator, dtype=torch.float64)

    known = draw(POSES, PIXELS, OWN) + draw(POSES, 1, OWN)
    further = draw(POSES, PIXELS, FURTHER) + draw(POSES, 1, FURTHER) + known[..., :FURTHER]
    noise = draw(POSES, PIXELS) + per_pose * draw(POSES, 1)
    return known, further, share * further[..., 0] + noise


ZERO = torch.zeros(OWN, dtype=torch.float64)
NO_PRIOR = NormalEquations(ZERO.sum(), ZERO, torch.outer(ZERO, ZERO))


def _compared(
    known: torch.Tensor,
    further: torch.Tensor,
    residual: torch.Tensor,
    prior: NormalEquations = NO_PRIOR,
) -> AddedColumns:
    columns = torch.cat([known, further, residual[..., None]], dim=2)
    return AddedColumns(columns.transpose(1, 2) @ columns, prior)


def _least_squares(columns: torch.Tensor, residual: torch.Tensor) -> torch.Tensor:
    flat = columns.reshape(-1, columns.shape[-1])
    return -torch.linalg.lstsq(flat, residual.reshape(-1, 1)).solution[:, 0]


def test_values_and_shift_are_those_of_two_least_squares(generator: Generator) -> None:
    known, further, residual = _columns(generator, 0.3, 0.5)
    compared = _compared(known, further, residual)
    for chosen in ([0], [2, 1]):
        joint = _least_squares(torch.cat([known, further[..., chosen]], dim=2), residual)
        moved = present(compared(chosen))
        torch.testing.assert_close(moved.values, joint[OWN:])
        torch.testing.assert_close(moved.shift, joint[:OWN] - _least_squares(known, residual))


def test_the_p_value_is_that_of_leaving_out_each_pose(generator: Generator) -> None:
    known, further, residual = _columns(generator, 0.1, 0.5)
    both = torch.cat([known, further[..., :1]], dim=2)
    others = [torch.arange(POSES) != left_out for left_out in range(POSES)]
    without = torch.stack([_least_squares(both[kept], residual[kept])[-1] for kept in others])
    variance = (POSES - 1) / POSES * (without - without.mean()).square().sum()
    moved = present(_compared(known, further, residual)([0]))
    ratio = float(moved.values[0].square() / variance)
    assert moved.p_value == pytest.approx(2 * t.sf(ratio**0.5, POSES - 1), rel=1e-4)


def test_nothing_is_found_as_often_as_the_level_says(generator: Generator) -> None:
    """Poses share most of the noise: pixels that counted as independent would find much more."""
    drawn = (_columns(generator, 0.0, 1.0) for _ in range(200))
    # Of 200 draws at 5 %, more than 19 have a probability of 0.2 %.
    assert sum(present(_compared(*one)([0])).p_value < 0.05 for one in drawn) <= 19


def test_a_column_that_the_others_explain_says_nothing(generator: Generator) -> None:
    known, further, residual = _columns(generator, 0.3, 0.5)
    further[..., 0] = known @ torch.ones(OWN, dtype=torch.float64)
    compared = _compared(known, further, residual)
    assert compared([0]) is None
    assert compared([1]) is not None


def test_a_prior_counts_as_further_observations(generator: Generator) -> None:
    """A pose whose rows are those of the prior, and that is never left out, says the same."""
    known, further, residual = _columns(generator, 0.3, 0.5)
    rows = torch.randn(6, OWN, generator=generator, dtype=torch.float64)
    off = torch.randn(6, generator=generator, dtype=torch.float64)
    prior = NormalEquations(off @ off, rows.T @ off, rows.T @ rows)
    moved = present(_compared(known, further, residual, prior)([0]))
    flat = torch.cat([known, further[..., :1]], dim=2).reshape(-1, OWN + 1)
    padded = torch.cat([flat, torch.cat([rows, torch.zeros(6, 1).double()], dim=1)])
    joint = _least_squares(padded[None], torch.cat([residual.flatten(), off])[None])
    torch.testing.assert_close(moved.values, joint[OWN:])


def test_a_direction_without_information_stays_where_it_is(generator: Generator) -> None:
    known, further, residual = _columns(generator, 0.3, 0.5)
    known[..., 1] = known[..., 0]
    moved = present(_compared(known, further, residual)([0]))
    torch.testing.assert_close(moved.shift[0], moved.shift[1])
    alone = torch.cat([known[..., 1:], further[..., :1]], dim=2)
    torch.testing.assert_close(moved.values, _least_squares(alone, residual)[-1:])


def test_the_unbiased_covariance_is_right_on_average_with_more_unknowns_than_poses() -> None:
    """A sum over unit errors is the mean over white ones: the covariance is a square of them."""
    rows = torch.randn(8, 3, 10, dtype=torch.float64)  # Poses, observations of each, unknowns.
    hessian, found = rows.mT @ rows, torch.zeros(10, 10, dtype=torch.float64)
    whole = Curvature(hessian.sum(dim=0))
    for error in torch.eye(24, dtype=torch.float64).view(24, 8, 3, 1):
        off = whole.inverse @ (rows.mT @ error).sum(dim=0)
        gradient = (rows.mT @ (rows @ off - error))[..., 0]
        found += unbiased_covariance(NormalEquations(gradient[:, 0], gradient, hessian), whole)
    assert torch.allclose(found, whole.inverse, rtol=1e-6, atol=1e-9)
