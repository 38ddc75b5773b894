"""Predictions of held-out poses, against dense normal distributions."""

import pytest
import torch
from torch import Tensor

from tofcorr.diagnosis.sums.gains import flipped_gains
from tofcorr.diagnosis.sums.linear_system import Layout, Sums, draw_folds, draw_signs

NUM_UNITS, NUM_VALUES = 12, 5
SIGMA = 0.3


def _sums(columns: Tensor, values: Tensor, prior: Tensor) -> Sums:
    """Return the sums of values (U, N) and columns (U, N, 3): one of the base, two of an effect."""
    layout = Layout(base=1, effects={"effect": (1, 3)}, prior=torch.diag(prior))
    turned = columns.transpose(1, 2) / SIGMA**2
    score = (turned @ values[:, :, None])[..., 0]
    square = values.square().sum(1) / SIGMA**2
    return Sums(gram=turned @ columns, score=score, square=square, scale=1.0, layout=layout)


def _chi_squared_fall(columns: Tensor, values: Tensor, prior: Tensor, folds: Tensor) -> float:
    """Sum over folds how far chi-squared falls when the others' fit predicts the fold."""
    fall = 0.0
    for inside in folds > 0:
        known, values_known = columns[~inside].flatten(0, 1), values[~inside].flatten()
        precision = known.T @ known / SIGMA**2 + torch.diag(prior)
        uncertainty = torch.linalg.inv(precision)
        theta = uncertainty @ known.T @ values_known / SIGMA**2
        new, seen = columns[inside].flatten(0, 1), values[inside].flatten()
        spread = SIGMA**2 * torch.eye(len(seen)).double() + new @ uncertainty @ new.T
        left = seen - new @ theta
        fall += float(seen @ seen) / SIGMA**2 - float(left @ torch.linalg.solve(spread, left))
    return fall


@pytest.fixture
def drawn() -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Columns, values, prior and folds without any structure."""
    generator = torch.Generator().manual_seed(5)
    shape = (NUM_UNITS, NUM_VALUES)
    columns = torch.randn(*shape, 3, generator=generator, dtype=torch.float64)
    values = 0.4 * columns[..., 0] + 0.2 * columns[..., 2]
    values = values + SIGMA * torch.randn(*shape, generator=generator, dtype=torch.float64)
    prior = torch.tensor([0.1, 1.0, 2.0], dtype=torch.float64)
    return columns, values, prior, draw_folds(NUM_UNITS, 4, generator)


def test_gains_are_those_of_predictions_with_their_uncertainty(
    drawn: tuple[Tensor, Tensor, Tensor, Tensor],
) -> None:
    columns, values, prior, folds = drawn
    signs = torch.ones(0, NUM_UNITS, dtype=torch.float64)
    gains = flipped_gains(_sums(columns, values, prior), [], ["effect"], folds, signs)["effect"]
    larger = _chi_squared_fall(columns, values, prior, folds)
    smaller = _chi_squared_fall(columns[..., :1], values, prior[:1], folds)
    assert gains.tolist() == pytest.approx([larger - smaller])


def test_what_is_flipped_is_the_residual_of_the_larger_model(
    drawn: tuple[Tensor, Tensor, Tensor, Tensor],
) -> None:
    columns, values, prior, folds = drawn
    signs = draw_signs(3, NUM_UNITS, torch.Generator().manual_seed(2))
    sums = _sums(columns, values, prior)
    gains = flipped_gains(sums, [], ["effect"], folds, signs)["effect"]
    theta = sums.left_out_solutions(["effect"])
    residual = values - (columns @ theta[:, :, None])[..., 0]
    for flip, gain in zip(signs, gains[1:].tolist(), strict=True):
        flipped = flip[:, None] * residual
        larger = _chi_squared_fall(columns, flipped, prior, folds)
        smaller = _chi_squared_fall(columns[..., :1], flipped, prior[:1], folds)
        assert gain == pytest.approx(larger - smaller)


def test_a_pose_that_others_hardly_predict_does_not_hide_an_effect() -> None:
    """One coefficient of the effect shows in all poses, the other almost only in the first one."""
    generator = torch.Generator().manual_seed(8)
    shape = (40, NUM_VALUES)
    columns = torch.randn(*shape, 3, generator=generator, dtype=torch.float64)
    columns[1:, :, 2] *= 0.01
    values = 0.15 * columns[..., 1]
    values = values + SIGMA * torch.randn(*shape, generator=generator, dtype=torch.float64)
    prior = torch.tensor([0.1, 1.0, 1e-4], dtype=torch.float64)
    signs = draw_signs(99, 40, generator)
    folds = draw_folds(40, 5, generator)
    gains = flipped_gains(_sums(columns, values, prior), [], ["effect"], folds, signs)["effect"]
    assert bool((gains[1:] < gains[0]).all())


def test_residual_scores_have_the_variance_of_the_errors(
    drawn: tuple[Tensor, Tensor, Tensor, Tensor],
) -> None:
    """A square root of 1 - leverage, from eigenvectors, corrects the in-sample score exactly."""
    columns, values, prior, _ = drawn
    columns = columns.clone()
    columns[0, :, 2] *= 6.0  # One pose of high leverage.
    sums = _sums(columns, values, prior)
    gram, score, precision = sums.of(["effect"])
    whole = gram.sum(0) + precision
    root = torch.linalg.cholesky(whole)
    inside = torch.linalg.solve(root, score.T - (gram @ torch.linalg.solve(whole, score.sum(0))).T)
    turned = torch.linalg.solve(root, torch.linalg.solve(root, gram).transpose(1, 2))
    leverage, axes = torch.linalg.eigh(turned)
    assert 0.6 < float(leverage.max()) < 0.9
    across = (axes.transpose(1, 2) @ inside.T[:, :, None]) * (1 - leverage[:, :, None]) ** -0.5
    expected = (root @ axes @ across)[..., 0]
    theta = sums.left_out_solutions(["effect"])
    found = score - (gram @ theta[:, :, None])[..., 0]
    torch.testing.assert_close(found, expected, rtol=0.03, atol=0.03 * float(expected.abs().max()))


def test_a_pose_that_alone_determines_a_coefficient_does_not_dominate_the_flips() -> None:
    """Predicted by the others' fit, its residual would be a thousand times too large."""
    generator = torch.Generator().manual_seed(9)
    shape = (40, NUM_VALUES)
    columns = torch.randn(*shape, 3, generator=generator, dtype=torch.float64)
    columns[1:, :, 2] *= 1e-3
    values = SIGMA * torch.randn(*shape, generator=generator, dtype=torch.float64)
    sums = _sums(columns, values, torch.tensor([0.1, 1.0, 1e-4], dtype=torch.float64))
    gram, score, _ = sums.of(["effect"])
    theta = sums.left_out_solutions(["effect"])
    left = (score - (gram @ theta[:, :, None])[..., 0])[0]
    assert float(left.abs().max()) <= 6.0 * float((gram[0].diagonal() ** 0.5).max())
