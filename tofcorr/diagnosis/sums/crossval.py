"""Held-out improvement by an effect, refitted with base model and hand-eye in every fold."""

from collections.abc import Sequence

import torch
from torch import Tensor

from tofcorr.diagnosis.sums.blocks import Blocks, Sums
from tofcorr.diagnosis.sums.folds import Folds

LEFT_OUT = 0.5
"""How far residuals go from those of the fit to all poses to those of fits without their own."""


def flipped_gains(
    sums: Sums, fewer: Sequence[str], names: Sequence[str], folds: Folds, signs: Tensor
) -> Tensor:
    """Return the fall of chi-squared from one model to a larger one, over all held-out folds.

    What is flipped is the residual of the larger model: that of the smaller one holds the
    effect itself where there is one, and a strong effect would hide behind its own flips.

    Args:
        sums: What each pose says.
        fewer: Effects of the smaller model.
        names: Effects of the larger model: `fewer` first, then more.
        folds: What is held out.
        signs: Of the poses, shape (B, U).

    Returns:
        The data's, then that of every flip, shape (1 + B,).
    """
    gram, score, prior = sums.of(names)
    inside = folds.members()
    grams = torch.einsum("fu,uij->fij", inside, gram)
    theta = _left_out_solutions(gram, score, prior)
    residual = score - (gram @ theta[:, :, None])[..., 0]
    # A flip and a fold are both sums over poses: (folds, K, U) times (U, B).
    flipped = (inside[:, :, None] * residual).transpose(1, 2) @ signs.T
    rights = torch.cat([(inside @ score)[:, :, None], flipped], dim=2)
    size = len(sums.layout.of(fewer))
    less = _total_gain(grams[:, :size, :size], rights[:, :size], prior[:size, :size])
    return _total_gain(grams, rights, prior) - less


def _total_gain(grams: Tensor, rights: Tensor, prior: Tensor) -> Tensor:
    r"""Return how much better a model predicts all folds, each from all others, (R,).

    A prediction counts with its own uncertainty: for the fold f with sums A, b, and coefficients
    theta fitted to all others with precision C^-1, the chi-squared of y ~ N(X theta, V + X C X')
    falls by

    .. math:: \theta^T b + (b - A \theta)^T \theta_{all}

    (Woodbury's identity, with theta_all fitted to all folds). A single pose that determines
    a coefficient, such as the first one of a warm-up, cannot be predicted from the others: without
    the uncertainty it would outweigh all that they agree on. The logarithm of the determinant
    is left out: flips do not change it.

    Args:
        grams: A of each fold, shape (folds, K, K).
        rights: b of each fold, shape (folds, K, R).
        prior: Prior precision, shape (K, K).
    """
    theta = _without_each(grams, rights, prior)
    everywhere = torch.linalg.solve(grams.sum(0) + prior, rights.sum(0))
    return (theta * rights + (rights - grams @ theta) * everywhere).sum((0, 1))


def _without_each(grams: Tensor, rights: Tensor, prior: Tensor) -> Tensor:
    """Return the coefficients fitted to all folds but each, of the shape of `rights`."""
    return torch.linalg.solve(grams.sum(0) - grams + prior, rights.sum(0) - rights)


def held_out_squares(blocks: Blocks, names: Sequence[str], folds: Folds) -> Tensor:
    """Return the even sum of squared held-out residuals of each pose, shape (U,), m^2."""
    gram, score, prior = blocks.even.of(names)
    inside = folds.members()
    grams = torch.einsum("fu,uij->fij", inside, gram)
    theta = _without_each(grams, inside @ score, prior)[folds.of_unit]
    curved = (gram @ theta[:, :, None])[..., 0]
    return blocks.square - (theta * (2 * score - curved)).sum(1) / blocks.even_scale


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
    return _left_out_solutions(*sums.of(names))


def _left_out_solutions(gram: Tensor, score: Tensor, prior: Tensor) -> Tensor:
    whole, right = gram.sum(0), score.sum(0)
    without = torch.linalg.solve(whole - gram + prior, right - score)
    return (1 - LEFT_OUT) * torch.linalg.solve(whole + prior, right) + LEFT_OUT * without
