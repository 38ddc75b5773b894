r"""Held-out gains of effects, with a null distribution that is right for few poses.

A gain is measured in units of its own noise, as in a t-test: with l_u the scores of pose u for the
effect, of the residual of the larger model and beside the smaller one, the gain is divided by

.. math:: Q = \sum_u l_u^T S^{-1} l_u .

Its mean over all sign flips is the fall of chi-squared by chance, whatever the noise. With few
poses, or where few of them show an effect, Q is itself uncertain, and flips do not know it: on
recordings of 7 to 25 poses with nothing missing they rejected at 5 % in half of all cases. So the
null distribution of the quotient is drawn: scores of every pose are normal with the covariance A_u
that the likely sums imply, and run through the same fits. Of that model only the shape matters, as
in a t-test, because the quotient has no scale (Bell and McCaffrey 2002; Cameron and Miller 2015,
"A practitioner's guide to cluster-robust inference", on few clusters).
"""

from collections.abc import Sequence

import torch
from torch import Tensor

from tofcorr.diagnosis.sums.blocks import Sums
from tofcorr.diagnosis.sums.crossval import LEFT_OUT
from tofcorr.diagnosis.sums.elimination import Elimination, sums_over
from tofcorr.diagnosis.sums.folds import Folds
from tofcorr.diagnosis.sums.positive import inverse_squares, solve_positive

# Added to the covariance of a pose's scores, as a share of each variance: columns that one pose
# cannot distinguish leave it singular. Far above rounding, far below what a prior adds.
_RIDGE = 1e-11
# Least Q, in units of chi-squared. Chosen: an effect that the model absorbs entirely has none.
_LEAST_SCALE = 1e-9


class StudentGains:
    """Falls of chi-squared by one more effect, over all held-out folds.

    Args:
        sums: Likely sums of every pose.
        chosen: Effects of the smaller model.
        folds: Which poses are held out together.
        draws: Scores of every pose under the null hypothesis, from `normal_scores`, (U, P, B); with
            none only the fall itself is known.
    """

    def __init__(self, sums: Sums, chosen: Sequence[str], folds: Folds, draws: Tensor) -> None:
        inside = folds.members()
        # The last fit leaves out nothing.
        kept = 1 - torch.cat([inside, torch.zeros_like(inside[:1])])
        self._sums, self._kept = sums, kept
        # The observed scores, then the drawn ones, (U, P, 1 + B).
        self._scores = scores = torch.cat([sums.score[:, :, None], draws], dim=2)
        self._fits = Elimination(sums, chosen, sums_over(kept))
        model = scores[:, self._fits.members]
        self._of_fits = torch.tensordot(self._kept, model, dims=1)
        self._noise = _GainNoise(sums, chosen, scores) if draws.shape[2] else None

    def of(self, name: str) -> Tensor:
        """Return the fall by one more effect, then its null distribution, shape (1 + B,).

        The null distribution is that of the quotient, times the observed Q.
        """
        reduced = self._fits.beside(name)
        own = self._scores[:, slice(*self._sums.layout.effects[name])]
        across = reduced.across
        right = torch.tensordot(self._kept, own, dims=1) - across.mT @ self._of_fits
        falls = inverse_squares(reduced.normal, right)
        gains = (falls[-1] - falls[:-1]).sum(0)
        if self._noise is None:
            return gains
        scale = self._noise.of(name, own, across[-1], reduced.normal[-1])
        return torch.cat([gains[:1], gains[1:] / scale[1:] * scale[0]])


class _GainNoise:
    """The noise of a gain, Q, of observed and drawn scores.

    Args:
        sums: Likely sums of every pose.
        chosen: Effects of the smaller model.
        scores: Shape (U, P, R).
    """

    def __init__(self, sums: Sums, chosen: Sequence[str], scores: Tensor) -> None:
        self._sums, self._chosen = sums, chosen
        self._model = scores[:, sums.layout.of(chosen)]

    def of(self, name: str, own: Tensor, across: Tensor, normal: Tensor) -> Tensor:
        """Return Q of one more effect, shape (R,).

        Args:
            name: Of the effect.
            own: Its scores, shape (U, E, R).
            across: Z of the fit to all poses, shape (K, E).
            normal: S of that fit, shape (E, E).
        """
        beside = torch.cat([-across, torch.eye(own.shape[1], dtype=own.dtype)]).T
        scores = torch.cat([self._model, own], dim=1)
        gram, _, prior = self._sums.of([*self._chosen, name])
        # The coefficients of `crossval.left_out_solutions`, as matrices of all scores and of those
        # of the pose.
        fits = [_inverse(gram.sum(0) + prior - share * gram) for share in LEFT_OUT]
        of_all = torch.stack(fits).mean(0)
        of_pose = torch.stack([share * fit for share, fit in zip(LEFT_OUT, fits, strict=True)])
        rows = beside @ gram
        left = (beside + rows @ of_pose.mean(0)) @ scores - (rows @ of_all) @ scores.sum(0)
        left = left.transpose(0, 1)
        squares = inverse_squares(normal, left.flatten(1)).unflatten(0, left.shape[1:])
        return squares.sum(0).clamp(min=_LEAST_SCALE)


def _inverse(matrices: Tensor) -> Tensor:
    return solve_positive(matrices, torch.eye(matrices.shape[-1], dtype=matrices.dtype))


def normal_scores(sums: Sums, count: int, generator: torch.Generator) -> Tensor:
    """Draw the scores of every pose from a normal distribution with the covariance A_u.

    Args:
        sums: Likely sums of every pose.
        count: Number of draws B.
        generator: Of the draws.

    Returns:
        Shape (U, P, B).
    """
    size = sums.gram.diagonal(dim1=1, dim2=2).clamp(min=torch.finfo(torch.float64).tiny).sqrt()
    correlation = sums.gram / (size[:, :, None] * size[:, None, :])
    correlation = correlation + _RIDGE * torch.eye(size.shape[1], dtype=torch.float64)
    factor, failed = torch.linalg.cholesky_ex(correlation)
    if bool(failed.any()):
        values, vectors = torch.linalg.eigh(correlation)
        factor = vectors * values.clamp(min=0).sqrt()[:, None, :]
    noise = torch.randn(*size.shape, count, generator=generator, dtype=torch.float64)
    return size[:, :, None] * (factor @ noise)
