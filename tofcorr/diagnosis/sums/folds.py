"""Cross-validation folds and sign flips of the units of a test."""

from dataclasses import dataclass

import torch
from torch import Tensor


@dataclass(frozen=True, kw_only=True)
class Folds:
    """An assignment of units to folds.

    Attributes:
        of_unit: The fold of each unit, shape (U,), int64.
        count: Number of folds.
    """

    of_unit: Tensor
    count: int

    def members(self) -> Tensor:
        """Return which units each fold holds out, shape (folds, U), float64."""
        numbers = torch.arange(self.count)
        return (self.of_unit[None] == numbers[:, None]).double()


def assign_folds(num_units: int, count: int, generator: torch.Generator) -> Folds:
    """Assign units at random to folds of equal size; no more folds than units."""
    count = min(count, num_units)
    order = torch.randperm(num_units, generator=generator)
    of_unit = torch.empty(num_units, dtype=torch.int64)
    of_unit[order] = torch.arange(num_units) % count
    return Folds(of_unit=of_unit, count=count)


def draw_signs(flips: int, num_units: int, generator: torch.Generator) -> Tensor:
    """Draw a sign for every unit and flip, shape (flips, U)."""
    return 2.0 * torch.randint(0, 2, (flips, num_units), generator=generator).double() - 1.0
