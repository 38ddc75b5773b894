"""Which poses are held out together, and which change their sign together."""

from dataclasses import dataclass

import torch
from torch import Tensor


@dataclass(frozen=True, kw_only=True)
class Folds:
    """Poses dealt into folds: `of_unit`, shape (U,), int64."""

    of_unit: Tensor
    count: int

    def members(self) -> Tensor:
        """Return which poses each fold holds, shape (folds, U), float64."""
        numbers = torch.arange(self.count)
        return (self.of_unit[None] == numbers[:, None]).double()


def deal(num_units: int, count: int, generator: torch.Generator) -> Folds:
    """Deal poses into folds of equal size, at random."""
    count = min(count, num_units)
    order = torch.randperm(num_units, generator=generator)
    of_unit = torch.empty(num_units, dtype=torch.int64)
    of_unit[order] = torch.arange(num_units) % count
    return Folds(of_unit=of_unit, count=count)


def draw_signs(flips: int, num_units: int, generator: torch.Generator) -> Tensor:
    """Draw a sign for every pose and flip, shape (flips, U)."""
    return 2.0 * torch.randint(0, 2, (flips, num_units), generator=generator).double() - 1.0
