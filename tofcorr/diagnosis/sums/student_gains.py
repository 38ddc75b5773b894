r"""Held-out gains of effects, with a null distribution that is right for few poses.

A gain is measured in units of its own noise, as in a t-test: with l_u the scores of pose u for the
effect, of the residual of the larger model and beside the smaller one, the gain is divided by

.. math:: Q = \sum_u l_u^T S^{-1} l_u .

Its mean over all sign flips is the fall of chi-squared by chance, whatever the noise. With few
poses, or where few of them show an effect, Q is itself uncertain, and flips do not know it: on
recordings of 7 to 25 poses with nothing missing they rejected at 5 % in half of all cases. So the
null distribution of the quotient is drawn: scores of every pose are normal with the covariance A_u
that the likely sums imply (`score_draws`), and run through the same fits. Of that model only the
shape matters, as in a t-test, because the quotient has no scale (Bell and McCaffrey 2002; Cameron
and Miller 2015, "A practitioner's guide to cluster-robust inference", on few clusters).
"""

from collections.abc import Mapping, Sequence

import torch
from torch import Tensor

from tofcorr.diagnosis.sums.blocks import Sums
from tofcorr.diagnosis.sums.elimination import Elimination, sums_over
from tofcorr.diagnosis.sums.folds import Folds
from tofcorr.diagnosis.sums.gain_noise import Added, gain_noise
from tofcorr.diagnosis.sums.score_draws import NullScores


def student_gains(
    sums: Sums,
    chosen: Sequence[str],
    names: Sequence[str],
    folds: Folds,
    null: NullScores | None = None,
) -> dict[str, Tensor]:
    """Return the fall of chi-squared by each of some effects, then its null distribution, (1 + B,).

    The null distribution is that of the quotient, times the observed Q.

    Args:
        sums: Likely sums of every pose.
        chosen: Effects of the smaller model.
        names: The effects of which one is added.
        folds: Which poses are held out together.
        null: Scores under the null hypothesis; without them only the fall itself is returned.
    """
    inside = folds.members()
    # The last fit leaves out nothing.
    kept = 1 - torch.cat([inside, torch.zeros_like(inside[:1])])
    fits = Elimination(sums, chosen, sums_over(kept))
    effects = {name: _added(name, sums, fits) for name in names}
    observed = torch.tensordot(inside, sums.score, dims=1)[:, :, None]
    gains = _falls(effects, fits.members, observed)
    if null is None:
        return gains
    of_folds = null.of_folds()
    drawn = _falls(effects, fits.members, of_folds)
    noise = gain_noise(effects, sums, fits, null, of_folds)
    return {
        name: torch.cat([gains[name], drawn[name] / noise[name][1:] * noise[name][0]])
        for name in names
    }


def _added(name: str, sums: Sums, fits: Elimination) -> Added:
    reduced = fits.beside(name)
    own = slice(*sums.layout.effects[name])
    return Added(own=own, across=reduced.across, root=_inverse_root(reduced.normal))


def _inverse_root(matrices: Tensor) -> Tensor:
    """Return R with R' R = S^-1; where rounding leaves some S singular, of the positive parts."""
    factor, failed = torch.linalg.cholesky_ex(matrices)
    if not bool(failed.any()):
        one = torch.eye(matrices.shape[-1], dtype=matrices.dtype)
        return torch.linalg.solve_triangular(factor, one, upper=False)
    values, vectors = torch.linalg.eigh(matrices)
    return torch.where(values > 0, values, torch.inf).rsqrt()[..., None] * vectors.mT


def _falls(effects: Mapping[str, Added], members: Tensor, of_folds: Tensor) -> dict[str, Tensor]:
    """Return the held-out falls of chi-squared by each effect, shape (R,), float64.

    Args:
        effects: The effects.
        members: Numbers of the model's columns.
        of_folds: Scores, added up over the poses of each fold, shape (folds, P, R).
    """
    total = of_folds.sum(0, keepdim=True)
    of_fits = torch.cat([total - of_folds, total])
    model = of_fits[:, members]
    falls = {}
    for name, effect in effects.items():
        across, root = effect.across.to(total.dtype), effect.root.to(total.dtype)
        right = torch.baddbmm(of_fits[:, effect.own], across.mT, model, alpha=-1)
        squares = (root @ right).square_().sum(1).double()
        falls[name] = (squares[-1] - squares[:-1]).sum(0)
    return falls
