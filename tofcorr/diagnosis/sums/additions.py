r"""Held-out gains of effects as additions to one model, in the data and under sign flips.

Where all units but one fold predict that fold, with the uncertainty of the prediction included, its
chi-squared is that of all units together less that of the others (the chain rule of the normal
distribution). The fall by an effect, summed over the folds, is therefore

.. math:: \sum_f \left( s^T S^{-1} s - s_{-f}^T S_{-f}^{-1} s_{-f} \right)

with the reduced equations of all units and of those without the fold (see `elimination`). The
others cannot predict a pose that alone determines a coefficient, such as the first one of a
warm-up. Without the uncertainty, its error would outweigh the gain of all other poses. The
log-determinant is omitted, because flips do not change it.
"""

from collections.abc import Sequence

import torch
from torch import Tensor

from tofcorr.diagnosis.sums.blocks import Blocks, Sums
from tofcorr.diagnosis.sums.crossval import mean_of_shares, without_shares_of_each
from tofcorr.diagnosis.sums.elimination import Elimination, sums_over
from tofcorr.diagnosis.sums.folds import Folds
from tofcorr.diagnosis.sums.positive import inverse_squares


class FlippedGains:
    """Falls of chi-squared by one more effect, over all held-out folds.

    The flips act on the residual of the larger model. The residual of the smaller one contains the
    effect where there is one, and would widen the null distribution of a strong effect.

    Args:
        sums: Likely sums of every unit.
        chosen: Effects of the smaller model.
        folds: Which units are held out together.
        signs: Sign flips of the units, shape (B, U).
    """

    def __init__(self, sums: Sums, chosen: Sequence[str], folds: Folds, signs: Tensor) -> None:
        self._sums, self._signs = sums, signs
        inside = folds.members()
        # The last fit leaves out nothing.
        self._kept = 1 - torch.cat([inside, torch.zeros_like(inside[:1])])
        self._fits = Elimination(sums, chosen, sums_over(self._kept))
        self._each = Elimination(sums, chosen, without_shares_of_each)

    def of(self, name: str) -> Tensor:
        """Return the fall by one more effect in the data, then under every flip, shape (1 + B,)."""
        reduced = self._fits.beside(name)
        model, own = self._residual(name)
        # Of every unit and fit, (S, U, E); a flip and a fit are both sums over units.
        left = (own - model @ reduced.across) * self._kept[:, :, None]
        rights = torch.cat([reduced.right[:, :, None], left.mT @ self._signs.T], dim=2)
        falls = inverse_squares(reduced.normal, rights)
        return (falls[-1] - falls[:-1]).sum(0)

    def _residual(self, name: str) -> tuple[Tensor, Tensor]:
        """Return the scores of the larger model's residual, (U, K) and (U, E).

        Its coefficients are those of `crossval.left_out_solutions`.
        """
        each = self._each
        reduced = each.beside(name)
        theta = reduced.solution()
        base = mean_of_shares(each.solution + reduced.change(theta))
        own = mean_of_shares(theta)
        model, own = each.products(name, base[:, :, None], own[:, :, None])
        score, span = self._sums.score, slice(*self._sums.layout.effects[name])
        return score[:, each.members] - model[..., 0], score[:, span] - own[..., 0]


class HeldOutSquares:
    """Even sums of squares of a model, and what one more effect closes of them.

    Args:
        blocks: Sums of every unit.
        chosen: Effects of the model.
        folds: Which units are held out together.

    Attributes:
        squares: Of the held-out residuals of each unit, by the model alone, shape (U,), m^2.
    """

    def __init__(self, blocks: Blocks, chosen: Sequence[str], folds: Folds) -> None:
        kept, score = 1 - folds.members(), blocks.even.score
        self._blocks, self._folds = blocks, folds
        self._fits = Elimination(blocks.even, chosen, sums_over(kept))
        theta = self._fits.solution[folds.of_unit]
        self._left = score - (self._fits.rows.mT @ theta[:, :, None])[..., 0]
        twice = (score + self._left)[:, self._fits.members]
        self.squares = blocks.square - (theta * twice).sum(1) / blocks.even_scale

    def closed(self, name: str) -> Tensor:
        """Return the fall of the sum of squares of each unit by one more effect, (U,), m^2."""
        reduced, left = self._fits.beside(name), self._left
        theta = reduced.solution()
        step = reduced.change(theta)[self._folds.of_unit], theta[self._folds.of_unit]
        curved = [rows[..., 0] for rows in self._fits.products(name, *(x[..., None] for x in step))]
        slopes = left[:, self._fits.members], left[:, slice(*self._blocks.layout.effects[name])]
        step, slopes, curved = (torch.cat(pair, dim=1) for pair in (step, slopes, curved))
        return (step * (2 * slopes - curved)).sum(1) / self._blocks.even_scale

    def closed_by_chance(self, names: Sequence[str], drawn: Tensor) -> dict[str, Tensor]:
        """Return what each of some effects closes of drawn scores, over all units, (B,) each, m^2.

        Args:
            names: The effects.
            drawn: Even scores, added up over the units of each fold, shape (folds, P, B).
        """
        sums, members = self._blocks.even, self._fits.members
        drawn = drawn.double()
        others = drawn.sum(0) - drawn
        model = torch.linalg.solve(self._fits.normal, others[:, members])
        grams = torch.tensordot(self._folds.members(), sums.gram, dims=1)
        left = drawn - grams[:, :, members] @ model
        closed = {}
        for name in names:
            own = torch.arange(*sums.layout.effects[name])
            reduced, both = self._fits.beside(name), torch.cat([members, own])
            right = others[:, own] - reduced.across.mT @ others[:, members]
            theta = torch.linalg.solve(reduced.normal, right)
            step = torch.cat([-reduced.across @ theta, theta], dim=1)
            slopes = 2 * left[:, both] - grams[:, both][:, :, both] @ step
            closed[name] = (step * slopes).sum((0, 1)) / self._blocks.even_scale
        return closed
