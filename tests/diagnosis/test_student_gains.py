"""The level of tests with few poses, and what they do not depend on."""

import pytest
import torch
from torch import Tensor

from tofcorr.diagnosis.sums.additions import FlippedGains
from tofcorr.diagnosis.sums.blocks import Sums
from tofcorr.diagnosis.sums.folds import Folds, assign_folds, draw_signs
from tofcorr.diagnosis.sums.layout import Layout
from tofcorr.diagnosis.sums.student_gains import StudentGains, normal_scores

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
    return Sums(gram=turned @ columns, score=(turned @ values[:, :, None])[..., 0], layout=layout)


def _drawn(sums: Sums, count: int, generator: torch.Generator) -> torch.Tensor:
    noise = torch.randn(*sums.score.shape, count, generator=generator, dtype=torch.float64)
    return normal_scores(sums, noise)


def _p_value(gains: Tensor) -> float:
    return float((gains[1:] >= gains[0]).double().mean())


@pytest.fixture(scope="module")
def folds() -> Folds:
    """Five folds of two poses."""
    return assign_folds(POSES, 5, torch.Generator().manual_seed(1))


def test_an_effect_of_three_poses_keeps_its_level_among_ten(folds: Folds) -> None:
    """Sign flips alone reject far too often here: three poses do not say how uncertain they are."""
    student, flipped = [], []
    for seed in range(200):
        generator = torch.Generator().manual_seed(seed)
        columns = _columns(generator)
        values = 3.0 * torch.randn(POSES, VALUES, generator=generator, dtype=torch.float64)
        sums = _sums(columns, values)
        draws = _drawn(sums, DRAWS, generator)
        student.append(_p_value(StudentGains(sums, [], folds, draws).of("effect")))
        signs = draw_signs(DRAWS, POSES, generator)
        flipped.append(_p_value(FlippedGains(sums, [], folds, signs).of("effect")))
    # Of 200 tests at 5 %, 20 or more reject with a probability of 0.3 %.
    assert sum(p < 0.05 for p in student) < 20
    assert sum(p < 0.05 for p in flipped) > 30


def test_an_effect_of_all_poses_is_found_among_ten(folds: Folds) -> None:
    generator = torch.Generator().manual_seed(3)
    columns = torch.randn(POSES, VALUES, 5, generator=generator, dtype=torch.float64)
    noise = torch.randn(POSES, VALUES, generator=generator, dtype=torch.float64)
    sums = _sums(columns, columns[:, :, 3] + noise)
    draws = _drawn(sums, DRAWS, generator)
    assert _p_value(StudentGains(sums, [], folds, draws).of("effect")) == 0.0


def test_the_p_value_does_not_depend_on_the_scale_of_the_noise(folds: Folds) -> None:
    generator = torch.Generator().manual_seed(4)
    columns = _columns(generator)
    values = torch.randn(POSES, VALUES, generator=generator, dtype=torch.float64)
    draws = _drawn(_sums(columns, values), DRAWS, generator)
    small, large = (
        StudentGains(_sums(columns, scale * values), [], folds, draws).of("effect")
        for scale in (1.0, 7.0)
    )
    torch.testing.assert_close(large, 49.0 * small)


def test_the_gain_is_that_of_flips_and_needs_no_draws(folds: Folds) -> None:
    generator = torch.Generator().manual_seed(6)
    columns = _columns(generator)
    sums = _sums(columns, torch.randn(POSES, VALUES, generator=generator, dtype=torch.float64))
    signs, none = torch.ones(0, POSES, dtype=torch.float64), torch.zeros(POSES, 5, 0).double()
    expected = FlippedGains(sums, [], folds, signs).of("effect")
    torch.testing.assert_close(StudentGains(sums, [], folds, none).of("effect"), expected)


def test_drawn_scores_have_the_covariance_of_the_sums() -> None:
    generator = torch.Generator().manual_seed(7)
    columns = _columns(generator)[:2]
    columns[0, :, 1] = columns[0, :, 0]  # Columns that one pose cannot distinguish.
    sums = _sums(columns, torch.zeros(2, VALUES, dtype=torch.float64))
    draws = _drawn(sums, 4000, generator)
    found = draws @ draws.mT / draws.shape[2]
    # A covariance of 4000 draws is known to 2 % of the standard deviations' product.
    size = sums.gram.diagonal(dim1=1, dim2=2).sqrt()
    assert float(((found - sums.gram) / (size[:, :, None] * size[:, None])).abs().max()) < 0.1
