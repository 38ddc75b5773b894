"""The columns of a linear system, each effect's in a matrix of its own."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from tofcorr.diagnosis.sums.layout import Layout


@dataclass(frozen=True, kw_only=True)
class Columns:
    """Columns over M pixels. They are never copied into one matrix of all pixels.

    Attributes:
        base: Of the base model, shape (M, K), metres per unit coefficient.
        effects: Of effects and probes, by name, shape (M, E) each, metres at one standard deviation
            of the prior.
    """

    base: Tensor
    effects: Mapping[str, Tensor]

    def of(self, names: Sequence[str]) -> list[Tensor]:
        """Return the columns of the base model and of some effects."""
        return [self.base, *(self.effects[name] for name in names)]

    def everything(self) -> list[Tensor]:
        """Return the columns of the base model and of all effects."""
        return self.of(list(self.effects))

    def layout(self, prior: Tensor) -> Layout:
        """Return which columns belong to what.

        Args:
            prior: Prior precision of the base model, shape (K, K).
        """
        places, start = {}, self.base.shape[1]
        for name, own in self.effects.items():
            places[name] = (start, start + own.shape[1])
            start += own.shape[1]
        ones = torch.eye(start - self.base.shape[1], dtype=torch.float64)
        return Layout(base=self.base.shape[1], effects=places, prior=torch.block_diag(prior, ones))

    def times(self, names: Sequence[str], coefficients: Tensor) -> Tensor:
        """Return what base model and some effects predict with coefficients (K,), (M,), metres."""
        parts = self.of(names)
        own = coefficients.split([part.shape[1] for part in parts])
        total = parts[0] @ own[0]
        for part, theta in zip(parts[1:], own[1:], strict=True):
            total.addmv_(part, theta)
        return total

    def where(self, used: Tensor) -> "Columns":
        """Return the columns with zeros in the pixels that are not used; bool of shape (M,)."""
        return Columns(
            base=torch.where(used[:, None], self.base, 0.0),
            effects={name: torch.where(used[:, None], x, 0.0) for name, x in self.effects.items()},
        )

    def with_changed(self, changed: Mapping[str, Tensor]) -> "Columns":
        """Return the columns with others for some effects."""
        return replace(self, effects={**self.effects, **changed})
