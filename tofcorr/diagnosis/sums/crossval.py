"""Held-out improvement by an effect, refitted with base model and hand-eye in every fold."""

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from tofcorr.diagnosis.sums.blocks import Blocks, Sums
from tofcorr.diagnosis.sums.folds import Folds

LEFT_OUT = tuple((1 + math.cos((2 * k + 1) * math.pi / 6)) / 2 for k in range(3))
"""Shares of a unit that are left out of the fits whose mean predicts it: the three nodes of the
Gauss-Chebyshev quadrature on [0, 1]. Derived in `left_out_solutions`."""


def flipped_gains(
    sums: Sums, fewer: Sequence[str], names: Sequence[str], folds: Folds, signs: Tensor
) -> Tensor:
    """Return the fall of chi-squared from one model to a larger one, over all held-out folds.

    The flips act on the residual of the larger model. The residual of the smaller one contains the
    effect where there is one, and would widen the null distribution of a strong effect.

    Args:
        sums: Likely sums of every unit.
        fewer: Effects of the smaller model.
        names: Effects of the larger model: `fewer` first, then more.
        folds: Which units are held out together.
        signs: Sign flips of the units, shape (B, U).

    Returns:
        The fall in the data, then under every flip, shape (1 + B,).
    """
    gram, score, prior = sums.of(names)
    inside = folds.members()
    grams = torch.einsum("fu,uij->fij", inside, gram)
    rights = (inside @ score)[:, :, None]
    if len(signs):
        theta = _left_out_solutions(gram, score, prior)
        residual = score - (gram @ theta[:, :, None])[..., 0]
        # A flip and a fold are both sums over units: (folds, K, U) times (U, B).
        flipped = (inside[:, :, None] * residual).transpose(1, 2) @ signs.T
        rights = torch.cat([rights, flipped], dim=2)
    size = len(sums.layout.of(fewer))
    less = _total_gain(grams[:, :size, :size], rights[:, :size], prior[:size, :size])
    return _total_gain(grams, rights, prior) - less


def _total_gain(grams: Tensor, rights: Tensor, prior: Tensor) -> Tensor:
    r"""Return the fall of chi-squared when all others predict each fold, summed over folds, (R,).

    The prediction includes its own uncertainty. For the fold with sums A, b, and coefficients
    theta fitted to all others with covariance C, the chi-squared of y ~ N(X theta, V + X C X')
    falls by

    .. math:: \theta^T b + (b - A \theta)^T \theta_{all}

    (Woodbury's identity, with theta_all fitted to all folds). The others cannot predict a pose that
    alone determines a coefficient, such as the first one of a warm-up. Without the uncertainty,
    its error would outweigh the gain of all other poses. The log-determinant is omitted, because
    flips do not change it.

    Args:
        grams: A of each fold, shape (folds, K, K).
        rights: b of each fold, shape (folds, K, R).
        prior: Prior precision, shape (K, K).
    """
    theta = _without_each(grams, rights, prior)
    everywhere = torch.linalg.solve(grams.sum(0) + prior, rights.sum(0))
    return (theta * rights + (rights - grams @ theta) * everywhere).sum((0, 1))


def _without_each(grams: Tensor, rights: Tensor, prior: Tensor) -> Tensor:
    """Return the coefficients fitted without each fold, in the shape of `rights`."""
    return torch.linalg.solve(grams.sum(0) - grams + prior, rights.sum(0) - rights)


def held_out_squares(blocks: Blocks, names: Sequence[str], folds: Folds) -> Tensor:
    """Return the even sum of squared held-out residuals of each unit, shape (U,), m^2."""
    gram, score, prior = blocks.even.of(names)
    inside = folds.members()
    grams = torch.einsum("fu,uij->fij", inside, gram)
    theta = _without_each(grams, inside @ score, prior)[folds.of_unit]
    curved = (gram @ theta[:, :, None])[..., 0]
    return blocks.square - (theta * (2 * score - curved)).sum(1) / blocks.even_scale


def left_out_squares(blocks: Blocks, names: Sequence[str], weights: Tensor | None = None) -> Tensor:
    """Return the even sum of squares of each unit, predicted by all others, shape (U,), m^2.

    Args:
        blocks: Sums of every unit.
        names: Effects of the model.
        weights: How often each unit counts, shape (U,); all its copies are left out together.
            None: once.
    """
    gram, score, prior = blocks.even.of(names)
    times = torch.ones(len(gram), dtype=torch.float64) if weights is None else weights
    counted, right = gram * times[:, None, None], score * times[:, None]
    without = counted.sum(0) - counted + prior
    theta = torch.linalg.solve(without, right.sum(0) - right)
    curved = torch.einsum("ui,uij,uj->u", theta, gram, theta)
    return blocks.square - (2 * (theta * score).sum(1) - curved) / blocks.even_scale


def left_out_solutions(sums: Sums, names: Sequence[str]) -> Tensor:
    r"""Return for every unit the coefficients that give its residual the variance of its error.

    A unit of leverage h has an in-sample residual that is too small by sqrt(1 - h), and a
    leave-one-out residual that is too large by 1 / sqrt(1 - h) (Bell and McCaffrey 2002). Leaving
    out a share t of the unit multiplies the in-sample residual by 1 / (1 - t h), and

    .. math:: (1 - h)^{-1/2} = \frac{1}{\pi} \int_0^1 \frac{dt}{\sqrt{t (1 - t)}\,(1 - t h)} ,

    so the mean over the nodes of a Gauss-Chebyshev quadrature has the right variance, for every
    direction of the coefficients by itself. With three nodes it is right to 1 % up to h = 0.75 and
    at most 6: a unit that alone determines a coefficient says nothing of its own error, and must
    not dominate the sign flips.

    Returns:
        Shape (U, K).
    """
    return _left_out_solutions(*sums.of(names))


def _left_out_solutions(gram: Tensor, score: Tensor, prior: Tensor) -> Tensor:
    whole, right = gram.sum(0) + prior, score.sum(0)
    solved = [torch.linalg.solve(whole - t * gram, right - t * score) for t in LEFT_OUT]
    return torch.stack(solved).mean(0)
