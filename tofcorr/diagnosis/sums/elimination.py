"""Fits of a model to many sets of poses at once, in which each further effect is eliminated."""

from collections.abc import Callable, Sequence
from functools import partial
from typing import NamedTuple

import torch
from torch import Tensor

from tofcorr.diagnosis.sums.linear_system import LEFT_OUT, Sums, solver

Fitted = Callable[[Tensor], Tensor]
"""Takes sums of all units, (U, ...), and returns those of the units of each of S fits, (S, ...)."""


def sums_over(kept: Tensor) -> Fitted:
    """Return what sums up the units that each of S fits keeps, shape (S, U)."""
    return partial(torch.tensordot, kept, dims=1)


def without_shares_of_each(values: Tensor) -> Tensor:
    """Sum up units (U, ...) without a share of each in turn, one fit a share and unit, (S, ...)."""
    shares = values.new_tensor(LEFT_OUT).reshape(-1, *[1] * values.ndim)
    return (values.sum(0) - shares * values).flatten(0, 1)


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

    def solution(self) -> tuple[Tensor, Tensor]:
        """Return what the effect adds to the model's coefficients, and its own, (S, K), (S, E)."""
        own = solver(self.normal)(self.right[:, :, None])
        return -(self.across @ own)[..., 0], own[..., 0]


class Elimination:
    r"""Fits of a model, its columns eliminated once for all effects that are added to it.

    Effects that are tested as additions to one model differ in their own columns alone. With
    columns m of the model and e of an effect, the equations N theta = b have the solution

    .. math:: Z = N_{mm}^{-1} N_{me}, \quad S = N_{ee} - N_{em} Z, \quad s = b_e - Z^T b_m,

    .. math:: \theta_e = S^{-1} s, \quad \theta_m = N_{mm}^{-1} b_m - Z \theta_e .

    The effect lowers chi-squared by s' S^-1 s below that of the model alone. The factors of one
    N_mm serve all effects; each then needs a system of its own few columns.

    Args:
        sums: Of all units.
        chosen: Effects of the model.
        fitted: What each of the S fits is fitted to.

    Attributes:
        members: Numbers of the model's columns, shape (K,).
        rows: Products of the model's columns and all, for every unit, shape (U, K, P).
        normal: N_mm, shape (S, K, K).
        solution: Coefficients of the model alone, shape (S, K).
    """

    def __init__(self, sums: Sums, chosen: Sequence[str], fitted: Fitted) -> None:
        self._sums, self._fitted = sums, fitted
        self.members = sums.layout.of(chosen)
        self.rows = sums.rows(chosen)
        self._normal = fitted(self.rows) + sums.layout.prior[self.members]
        self._right = fitted(sums.score)
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
        """Return A_u times coefficients of the model (U, K) and of one more effect (U, E).

        Returns:
            The rows of the model, shape (U, K), and those of the effect, shape (U, E).
        """
        span, model, own = slice(*self._sums.layout.effects[name]), model[..., None], own[..., None]
        across, gram = self.rows[:, :, span], self._sums.gram[:, span, span]
        of_model, of_own = self._inside @ model + across @ own, across.mT @ model + gram @ own
        return of_model[..., 0], of_own[..., 0]
