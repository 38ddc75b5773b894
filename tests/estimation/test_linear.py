"""Further unknowns beside an estimate: what least squares with and without them gives."""

import pytest
import torch
from optional import present

from tofcorr.estimation.linear import AddedColumns, NormalEquations

POSES, PIXELS, OWN, FURTHER = 24, 30, 4, 3


def _columns(
    generator: torch.Generator, share: float, per_pose: float
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Return columns of known and further unknowns, and residuals: (G, M, P), (G, M, F), (G, M)."""

    def draw(*size: int) -> torch.Tensor:
        return torch.randn(*size, generator=generator, dtype=torch.float64)

    known = draw(POSES, PIXELS, OWN) + draw(POSES, 1, OWN)
    further = draw(POSES, PIXELS, FURTHER) + draw(POSES, 1, FURTHER) + known[..., :FURTHER]
    noise = draw(POSES, PIXELS) + per_pose * draw(POSES, 1)
    return known, further, share * further[..., 0] + noise


def _no_prior(size: int = OWN) -> NormalEquations:
    zero = torch.zeros(size, dtype=torch.float64)
    return NormalEquations(zero.sum(), zero, torch.zeros(size, size, dtype=torch.float64))


def _products(*parts: torch.Tensor) -> torch.Tensor:
    columns = torch.cat(parts, dim=2)
    return columns.transpose(1, 2) @ columns


def _least_squares(columns: torch.Tensor, residual: torch.Tensor) -> torch.Tensor:
    flat = columns.reshape(-1, columns.shape[-1])
    return -torch.linalg.lstsq(flat, residual.reshape(-1, 1)).solution[:, 0]


def test_values_and_shift_are_those_of_two_least_squares(generator: torch.Generator) -> None:
    known, further, residual = _columns(generator, 0.3, 0.5)
    compared = AddedColumns(_products(known, further, residual[..., None]), _no_prior())
    for chosen in ([0], [2, 1]):
        joint = _least_squares(torch.cat([known, further[..., chosen]], dim=2), residual)
        moved = present(compared(chosen))
        torch.testing.assert_close(moved.values, joint[OWN:])
        torch.testing.assert_close(moved.shift, joint[:OWN] - _least_squares(known, residual))


def test_the_p_value_is_that_of_leaving_out_each_pose(generator: torch.Generator) -> None:
    known, further, residual = _columns(generator, 0.1, 0.5)
    compared = AddedColumns(_products(known, further, residual[..., None]), _no_prior())
    both = torch.cat([known, further[..., :1]], dim=2)
    others = [torch.arange(POSES) != left_out for left_out in range(POSES)]
    without = torch.stack([_least_squares(both[kept], residual[kept])[-1] for kept in others])
    variance = (POSES - 1) / POSES * (without - without.mean()).square().sum()
    moved = present(compared([0]))
    ratio = float(moved.values[0].square() / variance)
    from scipy.stats import t

    assert moved.p_value == pytest.approx(2 * t.sf(ratio**0.5, POSES - 1), rel=1e-4)


def test_nothing_is_found_as_often_as_the_level_says(generator: torch.Generator) -> None:
    """Poses share most of the noise: pixels that counted as independent would find much more."""
    p_values = []
    for _ in range(200):
        known, further, residual = _columns(generator, 0.0, 1.0)
        moved = present(
            AddedColumns(_products(known, further, residual[..., None]), _no_prior())([0])
        )
        p_values.append(moved.p_value)
    # Of 200 draws at 5 %, more than 19 have a probability of 0.2 %.
    assert sum(value < 0.05 for value in p_values) <= 19


def test_a_column_that_the_others_explain_says_nothing(generator: torch.Generator) -> None:
    known, further, residual = _columns(generator, 0.3, 0.5)
    further[..., 0] = known @ torch.ones(OWN, dtype=torch.float64)
    compared = AddedColumns(_products(known, further, residual[..., None]), _no_prior())
    assert compared([0]) is None
    assert compared([1]) is not None


def test_a_prior_counts_as_further_observations(generator: torch.Generator) -> None:
    """A pose whose rows are those of the prior, and that is never left out, says the same."""
    known, further, residual = _columns(generator, 0.3, 0.5)
    rows = torch.randn(6, OWN, generator=generator, dtype=torch.float64)
    off = torch.randn(6, generator=generator, dtype=torch.float64)
    prior = NormalEquations(off @ off, rows.T @ off, rows.T @ rows)
    moved = present(AddedColumns(_products(known, further, residual[..., None]), prior)([0]))
    flat = torch.cat([known, further[..., :1]], dim=2).reshape(-1, OWN + 1)
    padded = torch.cat([flat, torch.cat([rows, torch.zeros(6, 1).double()], dim=1)])
    joint = _least_squares(padded[None], torch.cat([residual.flatten(), off])[None])
    torch.testing.assert_close(moved.values, joint[OWN:])


def test_a_direction_without_information_stays_where_it_is(generator: torch.Generator) -> None:
    known, further, residual = _columns(generator, 0.3, 0.5)
    known[..., 1] = known[..., 0]
    moved = present(AddedColumns(_products(known, further, residual[..., None]), _no_prior())([0]))
    torch.testing.assert_close(moved.shift[0], moved.shift[1])
    alone = torch.cat([known[..., 1:], further[..., :1]], dim=2)
    torch.testing.assert_close(moved.values, _least_squares(alone, residual)[-1:])
