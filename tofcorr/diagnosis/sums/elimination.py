r"""Normal equations in which the columns of a model are eliminated, once for all further effects.

Effects that are tested as additions to one model differ in their own columns alone. With columns m
of the model and e of an effect, the equations N theta = b have the solution

.. math:: Z = N_{mm}^{-1} N_{me}, \quad S = N_{ee} - N_{em} Z, \quad s = b_e - Z^T b_m,

.. math:: \theta_e = S^{-1} s, \quad \theta_m = N_{mm}^{-1} b_m - Z \theta_e .

The effect lowers chi-squared by s' S^-1 s below that of the model alone. The factors of one N_mm
serve all effects; each then needs a system of its own few columns.
"""

from collections.abc import Callable, Sequence
from functools import partial
from typing import NamedTuple

import torch
from torch import Tensor

from tofcorr.diagnosis.sums.blocks import Sums
from tofcorr.diagnosis.sums.positive import solve_positive, solver

Fitted = Callable[[Tensor], Tensor]
"""Takes sums of all units, (U, ...), and returns those of the units of each of S fits, (S, ...)."""


def sums_over(kept: Tensor) -> Fitted:
    """Return what sums up the units that each of S fits keeps, shape (S, U)."""
    return partial(torch.tensordot, kept, dims=1)


class Reduced(NamedTuple):
    """The equations of one effect in S fits, beside the model.

    Attributes:
        across: Z, shape (S, K, E).
        normal: S, shape (S, E, E).
        right: s, shape (S, E).
    """

    across: Tensor
    normal: Tensor
    right: Tensor

    def solution(self) -> Tensor:
        """Return the coefficients of the effect, shape (S, E)."""
        return solve_positive(self.normal, self.right[:, :, None])[..., 0]

    def change(self, own: Tensor) -> Tensor:
        """Return how coefficients (S, E) of the effect change those of the model, shape (S, K)."""
        return -(self.across @ own[:, :, None])[..., 0]


class Elimination:
    """Fits of a model to all units but those that each of them leaves out.

    Args:
        sums: Of all units.
        chosen: Effects of the model.
        fitted: What each of the S fits is fitted to.

    Attributes:
        members: Numbers of the model's columns, shape (K,).
        rows: Products of the model's columns and all, for every unit, shape (U, K, P).
        normal: N_mm, shape (S, K, K).
        total_rows: Those rows and the prior, added up over all units, shape (K, P).
        solution: Coefficients of the model alone, shape (S, K).
    """

    def __init__(self, sums: Sums, chosen: Sequence[str], fitted: Fitted) -> None:
        self._sums, self._fitted = sums, fitted
        self.members = sums.layout.of(chosen)
        self.rows = sums.rows(chosen)
        prior = sums.layout.prior[self.members]
        self.total_rows = sums.total[self.members] + prior
        self._normal = self._fitted(self.rows) + prior
        self._right = self._fitted(sums.score)
        self.normal = self._normal[:, :, self.members]
        self._solve = solver(self.normal)
        self.solution = self._solve(self._right[:, self.members, None])[..., 0]
        self._inside = self.rows[:, :, self.members]

    def beside(self, name: str) -> Reduced:
        """Return the equations of one more effect."""
        own = slice(*self._sums.layout.effects[name])
        normal = self._fitted(self._sums.gram[:, own, own]) + self._sums.layout.prior[own, own]
        known, right = self._normal[:, :, own], self._right[:, self.members, None]
        across = self._solve(known)
        return Reduced(
            across=across,
            normal=normal - known.mT @ across,
            right=self._right[:, own] - (across.mT @ right)[..., 0],
        )

    def products(self, name: str, model: Tensor, own: Tensor) -> tuple[Tensor, Tensor]:
        """Return A_u times coefficients of the model (U, K, R) and of one more effect (U, E, R).

        Returns:
            The rows of the model, shape (U, K, R), and those of the effect, shape (U, E, R).
        """
        low, high = self._sums.layout.effects[name]
        across, gram = self.rows[:, :, low:high], self._sums.gram[:, low:high, low:high]
        return self._inside @ model + across @ own, across.mT @ model + gram @ own
