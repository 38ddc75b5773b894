"""The shares of the causes in the square of the gap: laws of a Shapley value, on exact toys."""

import itertools
import math
from dataclasses import replace

import pytest
import torch
from torch import Generator, Tensor

from tofcorr.diagnosis.findings.shares import (
    Parts,
    Share,
    held_solution,
    hidden_shares,
    scaled_shares,
    shapley_values,
    shrinkage_of_values,
    unchanged,
    values_beside_base,
)
from tofcorr.diagnosis.report.result import DiagnosisResult


def _random(generator: Generator, *shape: int) -> Tensor:
    return torch.randn(*shape, generator=generator, dtype=torch.float64)


def _toy(seed: int, causes: int = 4, size: int = 60) -> tuple[Tensor, Tensor]:
    """Return parts (size, causes) and a residual that is their sum and something else."""
    generator = Generator().manual_seed(seed)
    parts = _random(generator, size, causes)
    parts = parts + parts[:, :1]
    return parts, parts.sum(1) + 0.3 * _random(generator, size)


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


def _of_poses(
    causes: list[Share], columns: Tensor, residual: Tensor, prior: Tensor, *maps: Tensor
) -> Parts:
    """Return parts of columns (U, M, columns) and maps (U, M), and their fit to a residual."""
    beside = torch.stack([*maps, residual, torch.ones_like(residual)], 2)
    everything = torch.cat([columns, beside], 2)
    fitted = columns.mT @ columns, (columns.mT @ residual[:, :, None])[..., 0], prior
    return Parts(
        causes=tuple(causes),
        products=everything.mT @ everything,
        noise=torch.zeros(len(columns)).double(),
        start=torch.zeros(columns.shape[2]).double(),
        fitted=fitted,
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
    one = [part[None] for part in (columns, residual, *maps)]
    return _of_poses(causes, *one[:2], none, *one[2:]), residual


def test_beside_the_base_a_value_is_the_mean_fall_by_fits_over_all_orders() -> None:
    generator = Generator().manual_seed(9)
    base, effects = _random(generator, 300, 2), [_random(generator, 300, k) for k in (2, 1, 3)]
    effects[2] = 0.3 * effects[2] + base.sum(1, keepdim=True)  # The base absorbs most of it.
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
    generator = Generator().manual_seed(10)
    base, cause = _random(generator, 500, 2), _random(generator, 500, 1)
    alike = cause + 0.02 * _random(generator, 500, 1)
    error = cause[:, 0] + 0.5 * _random(generator, 500)
    parts, _ = _beside_base(base, [cause, alike], error)
    resamples = torch.ones(1, 1).double()
    true, other = values_beside_base(parts, resamples)[0].tolist()
    assert true + other == pytest.approx(1.0, rel=0.15)
    assert true == pytest.approx(other, rel=0.05)


def _of_simulator(effects: list[Tensor], prior: float, residual: Tensor) -> Parts:
    """Return parts of one pose: a constant that is the simulator's own, and effects (size,)."""
    columns = torch.stack([torch.ones_like(residual), *effects], 1)
    precision = prior * torch.eye(columns.shape[1]).double()
    precision[0, 0] = 0.0
    names = [f"effect {k}" for k in range(1, columns.shape[1])]
    causes = [Share(cause=n, kind="effect", members=(k,)) for k, n in enumerate(names, start=1)]
    own = Share(cause="distance", kind="parameter", members=(0,))
    return _of_poses([own, *causes], columns[None], residual[None], precision)


def test_effects_that_are_one_share_as_their_prior_has_it_and_the_interval_says_so() -> None:
    """Either may have all of it; resamples gave both a half, to a hundredth.

    Of coefficients a and b the data tell the sum. Their difference has the variance 2, so that
    either is off by its half: a standard deviation of 1 / sqrt(2).
    """
    column = _random(Generator().manual_seed(11), 1000)
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
    generator = Generator().manual_seed(12)
    one, other = _random(generator, 4000), _random(generator, 4000)
    parts = _of_simulator([one, other], 1.0, one + 2 * other)
    best = parts.refitted(torch.ones(1).double())
    assert max(shrinkage_of_values(parts, best)) < 0.01 * float(best.values.sum())


def test_without_a_simulator_nothing_is_as_given_and_shares_are_of_the_fitted_one(
    time_diagnosis: DiagnosisResult,
) -> None:
    found = time_diagnosis.to_mapping()
    assert found["version"] == 3
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


_POSES, _PIXELS = 24, 40
_CAUSES = (
    Share(cause="hand_eye", kind="parameter", members=(1,)),
    Share(cause="distance", kind="parameter", members=(0, 2)),
    Share(cause="drift", kind="effect", members=(3,)),
)


def _columns(seed: int) -> tuple[Tensor, Tensor]:
    """Return a constant, a shift along the axis, a slope and a drift, (U, M, 4), and noise."""
    generator = Generator().manual_seed(seed)
    tilt, distance = torch.rand(2, _POSES, _PIXELS, generator=generator, dtype=torch.float64)
    time = torch.linspace(0, 1, _POSES, dtype=torch.float64)[:, None].expand(_POSES, _PIXELS)
    columns = torch.stack([torch.ones_like(tilt), 1 - 0.15 * tilt, distance, 0.5 + time], dim=2)
    return columns, _random(generator, _POSES, _PIXELS)


def _parts(columns: Tensor, residual: Tensor, least: float) -> Parts:
    """Return the parts of a residual (U, M); `least`, m^2, is what a change must close."""
    precision = 1e-9 * torch.eye(4).double()
    parts = _of_poses(list(_CAUSES), columns, residual, precision)
    counts = parts.products[:, -1, -1]
    return replace(parts, least=dict.fromkeys(("hand_eye", "distance"), least * counts))


def _shares(parts: Parts, *, sparse: bool = True) -> dict[str, float]:
    values = parts.refitted(torch.ones(_POSES).double(), sparse=sparse).values
    names = [cause.cause for cause in _CAUSES]
    return dict(zip(names, (values / values.sum()).tolist(), strict=True))


def _truth(columns: Tensor, theta: Tensor) -> dict[str, float]:
    """Return the share of every cause in the square of the sum; means count as distance."""
    parts = {
        c.cause: (columns[:, :, list(c.members)] @ theta[list(c.members)]).ravel() for c in _CAUSES
    }
    constant = sum(float(part.mean()) for part in parts.values())
    parts = {name: part - part.mean() for name, part in parts.items()}
    parts["distance"] = parts["distance"] + constant
    whole = torch.stack(list(parts.values())).sum(0)
    return {name: float(part @ whole / (whole @ whole)) for name, part in parts.items()}


@pytest.mark.parametrize("seed", [11, 12, 13])
def test_a_right_hand_eye_transform_takes_nothing_of_a_distance_error(seed: int) -> None:
    columns, noise = _columns(seed)
    theta = torch.tensor([12.0, 0.0, 20.0, 0.0], dtype=torch.float64) * 1e-3
    # An error that no cause models, as an effect's model leaves it, resembles the shift's columns.
    missed = 2e-3 * (columns[:, :, 1] - columns[:, :, 1].mean()) / columns[:, :, 1].std()
    parts = _parts(columns, columns @ theta + 0.1 * missed + 1e-4 * noise, least=(0.3e-3) ** 2)
    true = _truth(columns, theta)
    assert _shares(parts)["hand_eye"] == 0.0
    assert _shares(parts)["distance"] == pytest.approx(true["distance"], abs=0.02)


@pytest.mark.parametrize("seed", [21, 22])
def test_a_hand_eye_transform_that_is_wrong_keeps_its_share(seed: int) -> None:
    columns, noise = _columns(seed)
    theta = torch.tensor([0.0, 40.0, 20.0, 0.0], dtype=torch.float64) * 1e-3
    parts = _parts(columns, columns @ theta + 1e-4 * noise, least=(0.3e-3) ** 2)
    assert _shares(parts)["hand_eye"] == pytest.approx(_truth(columns, theta)["hand_eye"], abs=0.02)


@pytest.mark.parametrize("theta", [(0, 0, 0, 5), (8, 0, 20, 5), (-8, 40, 0, 5)])
def test_a_constant_counts_as_distance_whichever_cause_has_it(theta: tuple[float, ...]) -> None:
    columns, noise = _columns(31)
    millimetres = torch.tensor(theta, dtype=torch.float64)
    parts = _parts(columns, 1e-3 * columns @ millimetres + 1e-4 * noise, least=(0.1e-3) ** 2)
    for sparse in (True, False):
        found = _shares(parts, sparse=sparse)
        assert found == pytest.approx(_truth(columns, millimetres), abs=0.02)


def test_moving_a_constant_from_one_cause_to_another_changes_no_share() -> None:
    columns, noise = _columns(41)
    theta = torch.tensor([8.0, 0.0, 20.0, 5.0], dtype=torch.float64) * 1e-3
    moved = columns.clone()
    moved[:, :, 3] += 4.0  # The same drift, counted from another start.
    response = columns @ theta + 1e-4 * noise
    found = [_shares(_parts(one, response, least=1e-8)) for one in (columns, moved)]
    assert found[0] == pytest.approx(found[1], abs=1e-6)


def test_nothing_is_hidden_where_nothing_is_left_and_more_where_more_is() -> None:
    columns, _ = _columns(71)
    parts = _parts(columns, columns @ torch.tensor([8.0, 5.0, 20.0, 5.0]).double(), least=1e-8)
    refitted = parts.refitted(torch.ones(_POSES).double())
    assert hidden_shares(parts, refitted, 0.0) == [0.0, 0.0, 0.0]
    little, much = (torch.tensor(hidden_shares(parts, refitted, left)) for left in (0.01, 0.04))
    assert torch.allclose(2 * little, much)
    # No cause of the simulator's own reaches more of the residual than all causes together.
    assert float(much[:2].max()) <= float(much[2]) + 1e-12
    assert float(much[2]) < 1.96 * (0.04 / 4) ** 0.5 + 1e-12


def test_a_held_solution_is_the_least_squares_fit_of_the_other_columns() -> None:
    columns, noise = _columns(51)
    flat, response = columns.reshape(-1, 4), noise.ravel()
    start = torch.tensor([1.0, -2.0, 0.5, 0.3], dtype=torch.float64)
    # Around the base fit the residual is what the start leaves.
    score = flat.T @ (response - flat @ start)
    found = held_solution(flat.T @ flat, score, start, [1, 3])
    expected = torch.linalg.lstsq(flat[:, [0, 2]], response[:, None]).solution[:, 0]
    assert torch.allclose(found[[0, 2]], expected)
    assert found[[1, 3]].tolist() == [0.0, 0.0]


@pytest.mark.parametrize(
    ("hand_eye", "distance", "held"),
    [(1e-12, 1e-12, set()), (1e9, 1e9, {"hand_eye", "distance"}), (1e3, 1e-12, {"hand_eye"})],
)
def test_a_parameter_stays_as_it_is_unless_a_change_closes_as_much_as_it_must(
    hand_eye: float, distance: float, held: set[str]
) -> None:
    columns, noise = _columns(62)
    theta = torch.tensor([5.0, 0.0, 20.0, 0.0], dtype=torch.float64)
    flat = columns.reshape(-1, 4)
    normal, score = flat.T @ flat, flat.T @ (flat @ theta + noise.ravel())
    groups = {"hand_eye": (1,), "distance": (0, 2)}
    least = {"hand_eye": hand_eye, "distance": distance}
    assert unchanged(normal, score, torch.zeros(4).double(), groups, least) == held
