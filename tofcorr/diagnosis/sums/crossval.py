"""Predictions of units that are left out of the fit one by one."""

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from tofcorr.diagnosis.sums.blocks import Blocks, Sums
from tofcorr.diagnosis.sums.positive import solve_positive

LEFT_OUT = tuple((1 + math.cos((2 * k + 1) * math.pi / 6)) / 2 for k in range(3))
"""Shares of a unit that are left out of the fits whose mean predicts it: the three nodes of the
Gauss-Chebyshev quadrature on [0, 1]. Derived in `left_out_solutions`."""


def left_out_squares(blocks: Blocks, names: Sequence[str]) -> Tensor:
    """Return the even sum of squares of each unit, predicted by all others, shape (U,), m^2.

    Args:
        blocks: Sums of every unit.
        names: Effects of the model.
    """
    return squares_at(blocks, names, left_out_coefficients(blocks.even, names))


def squares_at(blocks: Blocks, names: Sequence[str], coefficients: Tensor) -> Tensor:
    """Return the even sum of squares of each unit at given coefficients, shape (U,), m^2.

    Args:
        blocks: Sums of every unit.
        names: Effects of the model.
        coefficients: Of base model and effects, for every unit, shape (U, K).
    """
    gram, score, _ = blocks.even.of(names)
    curved = (gram @ coefficients[:, :, None])[..., 0]
    return blocks.square - (coefficients * (2 * score - curved)).sum(1) / blocks.even_scale


def left_out_coefficients(sums: Sums, names: Sequence[str]) -> Tensor:
    """Return for every unit the coefficients that all others give, shape (U, K)."""
    gram, score, prior = sums.of(names)
    others = gram.sum(0) + prior - gram, (score.sum(0) - score)[:, :, None]
    return solve_positive(*others)[..., 0]


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
    gram, score, prior = sums.of(names)
    whole, right = gram.sum(0) + prior, score.sum(0)
    rights = [(right - share * score)[:, :, None] for share in LEFT_OUT]
    pairs = zip(LEFT_OUT, rights, strict=True)
    solved = [solve_positive(whole - share * gram, own)[..., 0] for share, own in pairs]
    return torch.stack(solved).mean(0)


def without_shares_of_each(values: Tensor) -> Tensor:
    """Sum up units (U, ...) without a share of each in turn, one fit a share and unit, (S, ...)."""
    shares = values.new_tensor(LEFT_OUT).reshape(-1, *[1] * values.ndim)
    return (values.sum(0) - shares * values).flatten(0, 1)


def mean_of_shares(coefficients: Tensor) -> Tensor:
    """Return the mean of each unit's fits, shape (U, ...), from all of them, (S, ...)."""
    return coefficients.unflatten(0, (len(LEFT_OUT), -1)).mean(0)
