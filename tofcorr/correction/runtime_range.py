"""A calibrated range at runtime: values held to it, and which of them lie inside."""

import math

import torch
from torch import Tensor, nn

from tofcorr.error_terms.domain import Interval

# The smallest positive number of float32: less is no distance.
_SMALLEST = 2.0**-149


class RuntimeRange(nn.Module):
    """A range, in the form that is fastest for a chain of operations, or for compiled code.

    Args:
        interval: The range; both ends belong to it.
        positive: Whether zero and less are missing values, never inside and NaN once held.

    Attributes:
        fused: Whether the operations are compiled into one pass. Then a value inside is held to a
            few roundings, by subtractions and maxima alone: the code that is generated for clamps
            and choices, which turns masks into vectors and back, takes twice the time.
    """

    def __init__(self, interval: Interval, *, positive: bool = False) -> None:
        super().__init__()
        self.low, self.high = interval
        self.positive: bool = positive
        self.least: float = max(self.low, _SMALLEST) if positive else self.low
        self.fused: bool = False

    def held(self, x: Tensor) -> Tensor:
        """Return x held to the range, a new tensor; NaN stays NaN."""
        if self.fused:
            if self.positive:
                # Zero times infinity is NaN; any other number becomes zero.
                x = x + torch.relu(torch.relu(x) * -math.inf)
            return self.high - torch.relu((self.high - self.low) - torch.relu(x - self.low))
        if self.positive:
            return torch.threshold(x, 0.0, math.nan).clamp_(self.low, self.high)
        return torch.clamp(x, self.low, self.high)

    def inside(self, x: Tensor, held: Tensor) -> Tensor:
        """Return 1 where x is inside, else 0, of the type of `held`, which it may overwrite.

        Args:
            x: As measured.
            held: What `held` returned.
        """
        if self.fused:
            return ((x >= self.least) & (x <= self.high)).to(held.dtype)
        return held.eq_(x)
