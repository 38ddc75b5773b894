"""The level of tests with few poses, and what they do not depend on."""

from typing import Any

import pytest
import torch
from torch import Tensor

from tofcorr.diagnosis.sums.gains import (
    HeldOutSquares,
    NullScores,
    flipped_gains,
    student_gains,
)
from tofcorr.diagnosis.sums.linear_system import (
    NUM_POSE,
    Layout,
    PoseSums,
    Sums,
    draw_folds,
    draw_signs,
)

POSES, VALUES, DRAWS = 10, 6, 99


def _columns(generator: torch.Generator) -> Tensor:
    """Three columns of the base, two of an effect that three poses show."""
    columns = torch.randn(POSES, VALUES, 5, generator=generator, dtype=torch.float64)
    columns[:, :, :3] = columns[:, :1, :3]  # The base changes between poses alone.
    columns[:, :, 3:] = columns[:, :1, 3:]
    columns[3:, :, 3:] *= 0.1
    return columns


def _sums(columns: Tensor, values: Tensor) -> Sums:
    layout = Layout(
        base=3, effects={"effect": (3, 5)}, prior=1e-2 * torch.eye(5, dtype=torch.float64)
    )
    turned = columns.mT
    score = (turned @ values[:, :, None])[..., 0]
    square = values.square().sum(1)
    return Sums(gram=turned @ columns, score=score, square=square, scale=1.0, layout=layout)


def _drawn(sums: Sums, folds: Tensor, seed: int) -> NullScores:
    """Scores of poses that are certain: with pose columns that are zero."""
    products = torch.nn.functional.pad(sums.gram, (0, NUM_POSE + 1, 0, NUM_POSE + 1))
    return NullScores(_pose_sums(products, sums.layout), folds, DRAWS, seed)


def _pose_sums(weighted: Tensor, layout: Layout, **changed: Any) -> PoseSums:
    """Sums of poses that are known to a metre, with a dispersion of one."""
    given = {
        "plain": weighted,
        "count": torch.ones(len(weighted), dtype=torch.float64),
        "scale": 1.0,
        "dispersion": 1.0,
        "pose_sd": torch.ones(NUM_POSE, dtype=torch.float64),
    }
    return PoseSums(weighted=weighted, layout=layout, **(given | changed))


def _gains(sums: Sums, folds: Tensor, null: NullScores | None) -> Tensor:
    return student_gains(sums, [], ["effect"], folds, null)["effect"]


def _p_value(gains: Tensor) -> float:
    return float((gains[1:] >= gains[0]).double().mean())


@pytest.fixture(scope="module")
def folds() -> Tensor:
    """Five folds of two poses."""
    return draw_folds(POSES, 5, torch.Generator().manual_seed(1))


def test_an_effect_of_three_poses_keeps_its_level_among_ten(folds: Tensor) -> None:
    """Sign flips alone reject far too often here: three poses do not say how uncertain they are."""
    student, flipped = [], []
    for seed in range(200):
        generator = torch.Generator().manual_seed(seed)
        columns = _columns(generator)
        values = 3.0 * torch.randn(POSES, VALUES, generator=generator, dtype=torch.float64)
        sums = _sums(columns, values)
        student.append(_p_value(_gains(sums, folds, _drawn(sums, folds, seed))))
        signs = draw_signs(DRAWS, POSES, generator)
        flipped.append(_p_value(flipped_gains(sums, [], ["effect"], folds, signs)["effect"]))
    # Of 200 tests at 5 %, 20 or more reject with a probability of 0.3 %.
    assert sum(p < 0.05 for p in student) < 20
    assert sum(p < 0.05 for p in flipped) > 30


def test_an_effect_of_all_poses_is_found_among_ten(folds: Tensor) -> None:
    generator = torch.Generator().manual_seed(3)
    columns = torch.randn(POSES, VALUES, 5, generator=generator, dtype=torch.float64)
    noise = torch.randn(POSES, VALUES, generator=generator, dtype=torch.float64)
    sums = _sums(columns, columns[:, :, 3] + noise)
    assert _p_value(_gains(sums, folds, _drawn(sums, folds, 3))) == 0.0


def test_the_p_value_does_not_depend_on_the_scale_of_the_noise(folds: Tensor) -> None:
    generator = torch.Generator().manual_seed(4)
    columns = _columns(generator)
    values = torch.randn(POSES, VALUES, generator=generator, dtype=torch.float64)
    null = _drawn(_sums(columns, values), folds, 4)
    small, large = (_gains(_sums(columns, scale * values), folds, null) for scale in (1.0, 7.0))
    torch.testing.assert_close(large, 49.0 * small)


def test_the_gain_is_that_of_flips_and_needs_no_draws(folds: Tensor) -> None:
    generator = torch.Generator().manual_seed(6)
    columns = _columns(generator)
    sums = _sums(columns, torch.randn(POSES, VALUES, generator=generator, dtype=torch.float64))
    signs = torch.ones(0, POSES, dtype=torch.float64)
    expected = flipped_gains(sums, [], ["effect"], folds, signs)["effect"]
    torch.testing.assert_close(_gains(sums, folds, None), expected)


def test_drawn_scores_have_the_covariance_of_the_generalised_sums() -> None:
    """Whatever the poses' uncertainty and the dispersion are, and where columns are collinear."""
    generator = torch.Generator().manual_seed(7)
    columns = torch.randn(2, 12, 5 + NUM_POSE + 1, generator=generator, dtype=torch.float64)
    columns[0, :, 1] = columns[0, :, 0]  # Columns that one pose cannot distinguish.
    weighted = columns.mT @ columns
    plain = 2.5 * weighted
    layout = Layout(base=5, effects={}, prior=torch.eye(5, dtype=torch.float64))
    pose_sd = torch.tensor([0.2, 1.0, 0.5], dtype=torch.float64)
    sums = _pose_sums(weighted, layout, plain=plain, pose_sd=pose_sd, dispersion=1.7, scale=0.4)
    expected = sums.gls.gram
    null = NullScores(sums, torch.eye(2, dtype=torch.float64), 4000, 7)
    drawn = null.scores.double()
    size = drawn.std(2)
    # A covariance of 4000 draws is known to 2 % of the standard deviations' product.
    error = (drawn @ drawn.mT / drawn.shape[2] - expected) / (size[:, :, None] * size[:, None])
    assert float(error.abs().max()) < 0.1
    # Weights by likelihood are the inverse of the errors' covariance, so it cancels here.
    even = null.even_of_folds().double()
    error = drawn @ even.mT / drawn.shape[2] - 0.4 * plain[:, :5, :5]
    assert float((error / (size[:, :, None] * even.std(2)[:, None])).abs().max()) < 0.1


def test_what_an_effect_closes_by_chance_is_what_it_would_close_of_these_scores(
    folds: Tensor,
) -> None:
    generator = torch.Generator().manual_seed(9)
    columns = _columns(generator)
    values = torch.randn(2, POSES, VALUES, generator=generator, dtype=torch.float64)
    sums = [_sums(columns, own) for own in values]
    drawn = torch.stack([folds @ own.score for own in sums], dim=2)
    found = HeldOutSquares(sums[0], (), folds).closed_by_chance(["effect"], drawn)["effect"]
    for own, closed in zip(sums, found, strict=True):
        squares = HeldOutSquares(own, (), folds)
        torch.testing.assert_close(squares.closed("effect").sum(), closed)
