"""The shares of the causes in the square of the gap: laws of a Shapley value."""

import itertools
import math

import pytest
import torch
from torch import Tensor

from tofcorr.diagnosis.findings.shares import (
    Parts,
    Share,
    scaled_shares,
    shapley_values,
    shrinkage_of_values,
    values_beside_base,
)
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


def test_shares_of_parts_that_help_are_in_proportion_to_them() -> None:
    shares, _ = scaled_shares(torch.tensor([3.0, 1.0]).double(), total=2.5, left=1.5)
    assert torch.allclose(shares, torch.tensor([0.48, 0.16, 0.36]).double())


def test_parts_that_cancel_share_what_is_explained_held_out() -> None:
    """In the fit they explain less than nothing; each was given a share of 0 %, up to 2553 %."""
    shares, _ = scaled_shares(torch.tensor([1.6, -1.98]).double(), total=2.07, left=0.74)
    assert float(shares.sum()) == pytest.approx(1.0)
    assert float(shares[2]) == pytest.approx((0.74 / 2.07) ** 2)
    assert float(shares[0]) > 0.7
    assert 0 < float(shares[1]) < 0.2


def _of_one_pose(
    causes: list[Share], columns: Tensor, residual: Tensor, prior: Tensor, *maps: Tensor
) -> Parts:
    """Return parts of columns (size, columns) and maps (size,), and their fit to a residual."""
    ones = torch.ones_like(residual)
    everything = torch.stack([*columns.T, *maps, residual, ones], 1)
    return Parts(
        causes=tuple(causes),
        products=(everything.T @ everything)[None],
        noise=torch.zeros(1).double(),
        start=torch.zeros(columns.shape[1]).double(),
        fitted=((columns.T @ columns)[None], (columns.T @ residual)[None], prior),
        prior=prior,
        constant=0,
        least={},
    )


def _beside_base(
    base: Tensor, effects: list[Tensor], error: Tensor, maps: tuple[Tensor, ...] = ()
) -> tuple[Parts, Tensor]:
    """Return the parts of one pose (size, columns) and what the base model leaves of an error."""
    residual = error - base @ torch.linalg.lstsq(base, error).solution
    columns = torch.cat([base, *effects], 1)
    ends = [base.shape[1]]
    causes = []
    for own in effects:
        ends.append(ends[-1] + own.shape[1])
        causes.append(Share(cause="wiggling", kind="effect", members=tuple(range(*ends[-2:]))))
    fixed = range(ends[-1], ends[-1] + len(maps))
    causes += [Share(cause="fixed_pattern", kind="effect", fixed=place) for place in fixed]
    none = torch.zeros(columns.shape[1], columns.shape[1], dtype=torch.float64)
    return _of_one_pose(causes, columns, residual, none, *maps), residual


def _random(generator: torch.Generator, *shape: int) -> Tensor:
    return torch.randn(*shape, generator=generator, dtype=torch.float64)


def test_an_effect_that_the_base_model_absorbs_explains_what_it_closes() -> None:
    generator = torch.Generator().manual_seed(8)
    base = _random(generator, 400, 3)
    effect = base @ torch.ones(3, 1).double() + 0.3 * _random(generator, 400, 1)
    error = 5 * effect[:, 0] + 0.1 * _random(generator, 400)
    parts, residual = _beside_base(base, [effect], error)
    columns = torch.cat([base, effect], 1)
    left = residual - columns @ torch.linalg.lstsq(columns, residual).solution
    closed = residual.square().mean() - left.square().mean()
    once = torch.ones(1).double()
    assert torch.allclose(parts.refitted(once).values.sum(), closed, rtol=1e-9)
    assert torch.allclose(values_beside_base(parts, once[None]).sum(), closed, rtol=1e-9)


def test_beside_the_base_a_value_is_the_mean_fall_by_fits_over_all_orders() -> None:
    generator = torch.Generator().manual_seed(9)
    base, effects = _random(generator, 300, 2), [_random(generator, 300, k) for k in (2, 1, 3)]
    effects[1] = effects[1] + effects[0][:, :1]
    pattern = _random(generator, 300)
    error = torch.cat(effects, 1).sum(1) + 0.7 * pattern + _random(generator, 300)
    parts, residual = _beside_base(base, effects, error, (pattern,))

    def left(chosen: tuple[int, ...]) -> float:
        columns = torch.cat([base, *(effects[k] for k in chosen if k < 3)], 1)
        rest = residual - pattern if 3 in chosen else residual
        fitted = columns @ torch.linalg.lstsq(columns, rest).solution
        return float((rest - fitted).square().mean())

    expected = torch.zeros(4, dtype=torch.float64)
    for order in itertools.permutations(range(4)):
        for place, cause in enumerate(order):
            expected[cause] += left(order[:place]) - left(order[: place + 1])
    values = values_beside_base(parts, torch.ones(1, 1).double())[0]
    assert torch.allclose(values, expected / math.factorial(4), rtol=1e-9)


def test_an_effect_that_resembles_the_cause_gets_no_more_than_it_explains() -> None:
    """Two effects that are alike have large coefficients that cancel, and had shares of any size.

    The true one gets the larger share, and no share is negative.
    """
    generator = torch.Generator().manual_seed(10)
    base, cause = _random(generator, 500, 2), _random(generator, 500, 1)
    alike = cause + 0.02 * _random(generator, 500, 1)
    error = cause[:, 0] + 0.5 * _random(generator, 500)
    parts, _ = _beside_base(base, [cause, alike], error)
    resamples = torch.ones(1, 1).double()
    true, other = values_beside_base(parts, resamples)[0].tolist()
    assert true + other == pytest.approx(1.0, rel=0.15)
    assert true == pytest.approx(other, rel=0.05)
    together = parts.refitted(resamples[0]).values
    assert float(together.abs().max()) > 1.5 * max(true, other)


def _of_simulator(effects: list[Tensor], prior: float, residual: Tensor) -> Parts:
    """Return parts of one pose: a constant that is the simulator's own, and effects (size,)."""
    columns = torch.stack([torch.ones_like(residual), *effects], 1)
    precision = prior * torch.eye(columns.shape[1]).double()
    precision[0, 0] = 0.0
    names = [f"effect {k}" for k in range(1, columns.shape[1])]
    causes = [Share(cause=n, kind="effect", members=(k,)) for k, n in enumerate(names, start=1)]
    own = Share(cause="distance", kind="parameter", members=(0,))
    return _of_one_pose([own, *causes], columns, residual, precision)


def test_effects_that_are_one_share_as_their_prior_has_it_and_the_interval_says_so() -> None:
    """Either may have all of it; resamples gave both a half, to a hundredth.

    Of coefficients a and b the data tell the sum. Their difference has the variance 2, so that
    either is off by its half: a standard deviation of 1 / sqrt(2).
    """
    column = _random(torch.Generator().manual_seed(11), 1000)
    column -= column.mean()
    parts = _of_simulator([column, column], 1.0, 3.0 * column)
    best = parts.refitted(torch.ones(1).double())
    whole = float((3.0 * column).square().mean())
    assert best.values[1:].tolist() == pytest.approx([whole / 2] * 2, rel=1e-3)
    widths = shrinkage_of_values(parts, best)
    expected = 1.96 / math.sqrt(2) * 3.0 * float(column.square().mean())
    assert widths[1:] == pytest.approx([expected] * 2, rel=1e-2)
    assert widths[0] == pytest.approx(0.0, abs=1e-9)


def test_effects_that_the_data_tell_apart_owe_nothing_to_their_prior() -> None:
    generator = torch.Generator().manual_seed(12)
    one, other = _random(generator, 4000), _random(generator, 4000)
    parts = _of_simulator([one, other], 1.0, one + 2 * other)
    best = parts.refitted(torch.ones(1).double())
    assert max(shrinkage_of_values(parts, best)) < 0.01 * float(best.values.sum())


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
