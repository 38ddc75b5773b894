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
        self._sums = sums
        # The observed scores, then the drawn ones, (U, P, 1 + B).
        self._scores = scores = torch.cat([sums.score[:, :, None], draws], dim=2)
        self._fits = Elimination(sums, chosen, sums_over(kept))
        self._of_fits = torch.tensordot(kept, scores, dims=1)
        self._noise = _GainNoise(sums, chosen, scores) if draws.shape[2] else None

    def of(self, name: str) -> Tensor:
        """Return the fall by one more effect, then its null distribution, shape (1 + B,).

        The null distribution is that of the quotient, times the observed Q.
        """
        reduced = self._fits.beside(name)
        own, across = slice(*self._sums.layout.effects[name]), reduced.across
        right = self._of_fits[:, own] - across.mT @ self._of_fits[:, self._fits.members]
        falls = inverse_squares(reduced.normal, right)
        gains = (falls[-1] - falls[:-1]).sum(0)
        if self._noise is None:
            return gains
        scale = self._noise.of(name, self._scores[:, own], across[-1], reduced.normal[-1])
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
        self._total = scores.sum(0)

    def of(self, name: str, own: Tensor, across: Tensor, normal: Tensor) -> Tensor:
        """Return Q of one more effect, shape (R,).

        Args:
            name: Of the effect.
            own: Its scores, shape (U, E, R).
            across: Z of the fit to all poses, shape (K, E).
            normal: S of that fit, shape (E, E).
        """
        count = len(across)
        beside = torch.cat([-across, torch.eye(own.shape[1], dtype=own.dtype)]).T
        # In units in which S is one, Q is a sum of squares.
        beside = _inverse_root(normal) @ beside
        gram, _, prior = self._sums.of([*self._chosen, name])
        # The coefficients of `crossval.left_out_solutions`, as matrices of all scores and of those
        # of the pose.
        shares = gram.new_tensor(LEFT_OUT)[:, None, None, None]
        fits = _inverse(gram.sum(0) + prior - shares * gram)
        rows = beside @ gram
        of_pose, of_all = beside + rows @ (shares * fits).mean(0), rows @ fits.mean(0)
        left = torch.baddbmm(of_pose[:, :, :count] @ self._model, of_pose[:, :, count:], own)
        total = self._total[self._sums.layout.of([*self._chosen, name])]
        left = left.flatten(0, 1).addmm_(of_all.flatten(0, 1), total, alpha=-1)
        return left.square_().sum(0).clamp(min=_LEAST_SCALE)


def _inverse(matrices: Tensor) -> Tensor:
    return solve_positive(matrices, torch.eye(matrices.shape[-1], dtype=matrices.dtype))


def _inverse_root(matrix: Tensor) -> Tensor:
    """Return R with R' R = S^-1; where rounding leaves S singular, of its positive part."""
    factor, failed = torch.linalg.cholesky_ex(matrix)
    if not bool(failed):
        one = torch.eye(len(matrix), dtype=matrix.dtype)
        return torch.linalg.solve_triangular(factor, one, upper=False)
    values, vectors = torch.linalg.eigh(matrix)
    return torch.where(values > 0, values, torch.inf).rsqrt()[:, None] * vectors.T


def normal_scores(sums: Sums, noise: Tensor) -> Tensor:
    """Return scores of every pose from a normal distribution with the covariance A_u.

    Args:
        sums: Likely sums of every pose.
        noise: Standard normal numbers, shape (U, P, B).

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
    return (size[:, :, None] * factor) @ noise
