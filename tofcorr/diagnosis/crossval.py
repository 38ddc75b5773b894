"""Held-out improvement by an effect, refitted with base model and hand-eye in every fold."""

from collections.abc import Sequence

import torch
from torch import Tensor

from tofcorr.diagnosis.blocks import Blocks, Sums
from tofcorr.diagnosis.folds import Folds

LEFT_OUT = 0.5
"""How far residuals go from those of the fit to all poses to those of fits without their own."""


def fold_solutions(
    sums: Sums, names: Sequence[str], folds: Folds, score: Tensor | None = None
) -> Tensor:
    """Fit base model and effects without each fold.

    Args:
        sums: What each pose says.
        names: Effects of the model.
        folds: What is held out.
        score: Other right-hand sides than the data's, shape (U, P, R).

    Returns:
        Coefficients, shape (folds, K, R); R = 1 for the data.
    """
    inside = folds.members()
    gram, own, prior = sums.of(names)
    rest = gram.sum(0) - torch.einsum("fu,uij->fij", inside, gram) + prior
    rhs = own[:, :, None] if score is None else score[:, sums.layout.of(names)]
    right = rhs.sum(0) - torch.einsum("fu,uir->fir", inside, rhs)
    return torch.linalg.solve(rest, right)


def held_out_gain(
    sums: Sums, names: Sequence[str], folds: Folds, score: Tensor | None = None
) -> Tensor:
    """Return how much the sum of squares of each held-out pose falls by the model, shape (U, R).

    The reference is the base fit; only differences between models matter. In likely sums the
    sum of squares is chi-squared, in even sums m^2 times `even_scale`.
    """
    theta = fold_solutions(sums, names, folds, score)[folds.of_unit]
    gram, own, _ = sums.of(names)
    rhs = own[:, :, None] if score is None else score[:, sums.layout.of(names)]
    return (theta * (2 * rhs - gram @ theta)).sum(1)


def held_out_squares(blocks: Blocks, names: Sequence[str], folds: Folds) -> Tensor:
    """Return the even sum of squared held-out residuals of each pose, shape (U,), m^2."""
    gain = held_out_gain(blocks.even, names, folds)[:, 0]
    return blocks.square - gain / blocks.even_scale


def left_out_squares(blocks: Blocks, names: Sequence[str], weights: Tensor | None = None) -> Tensor:
    """Return the even sum of squares of each pose, fitted to all others, shape (U,), m^2.

    Args:
        blocks: What each pose says.
        names: Effects of the model.
        weights: How often each pose counts, shape (U,); none of its copies takes part. None: once.
    """
    gram, score, prior = blocks.even.of(names)
    times = torch.ones(len(gram), dtype=torch.float64) if weights is None else weights
    counted, right = gram * times[:, None, None], score * times[:, None]
    without = counted.sum(0) - counted + prior
    theta = torch.linalg.solve(without, right.sum(0) - right)
    curved = torch.einsum("ui,uij,uj->u", theta, gram, theta)
    return blocks.square - (2 * (theta * score).sum(1) - curved) / blocks.even_scale


def left_out_solutions(sums: Sums, names: Sequence[str]) -> Tensor:
    """Return for every pose the coefficients with which its residual looks like its error.

    A pose's residual to its own fit is too small, by the share h of it that the fit follows, and
    to a fit without it too large. Half-way between both its variance is right to first
    order in h: (1 + 1 / (1 - h)) / 2 is close to 1 / sqrt(1 - h).

    Returns:
        Shape (U, K).
    """
    gram, score, prior = sums.of(names)
    whole, right = gram.sum(0), score.sum(0)
    without = torch.linalg.solve(whole - gram + prior, right - score)
    return (1 - LEFT_OUT) * torch.linalg.solve(whole + prior, right) + LEFT_OUT * without


def left_out_scores(sums: Sums, names: Sequence[str]) -> Tensor:
    """Return b_u of the residuals of `left_out_solutions`, shape (U, P)."""
    members = sums.layout.of(names)
    theta = left_out_solutions(sums, names)
    return sums.score - (sums.gram[:, :, members] @ theta[:, :, None])[..., 0]
