"""Which columns of a linear system belong to the base model and to each effect."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor


@dataclass(frozen=True, kw_only=True)
class Layout:
    """Which columns belong to the base model and to each effect.

    Attributes:
        base: Number of columns of the base model; they come first. What is uncertain of the
            simulator's own error, or stands in for an amplitude that was not recorded, follows the
            terms and counts as part of the base model.
        effects: First column of every effect, and the one after its last.
        prior: Prior precision of all coefficients, shape (P, P). The columns of effects are scaled
            to a prior standard deviation of one.
    """

    base: int
    effects: dict[str, tuple[int, int]]
    prior: Tensor

    def size(self, name: str) -> int:
        """Return the number of an effect's columns."""
        low, high = self.effects[name]
        return high - low

    def only(self, names: Sequence[str]) -> "Layout":
        """Return the layout of the columns `of(names)` alone."""
        places, start = {}, self.base
        for name in names:
            low, high = self.effects[name]
            places[name] = (start, start + high - low)
            start += high - low
        return Layout(base=self.base, effects=places, prior=self.prior_of(self.of(names)))

    def of(self, names: Sequence[str]) -> Tensor:
        """Return the numbers of the base model's columns, then those of some effects, int64."""
        return torch.cat([torch.arange(*span) for span in self.spans(names)])

    def spans(self, names: Sequence[str]) -> list[tuple[int, int]]:
        """Return first column and the one after the last, of the base model, then of effects."""
        return [(0, self.base), *(self.effects[name] for name in names)]

    def prior_of(self, members: Tensor) -> Tensor:
        """Return the prior precision of some columns (K,), shape (K, K)."""
        return self.prior[members][:, members]


def blocks_between(matrices: Tensor, spans: Sequence[tuple[int, int]]) -> Tensor:
    """Return the rows and columns of some spans, out of matrices (..., P, P).

    Whole spans are copied several times faster than columns chosen by their numbers.
    """
    rows = [
        torch.cat([matrices[..., low:high, slice(*span)] for span in spans], dim=-1)
        for low, high in spans
    ]
    return torch.cat(rows, dim=-2)
