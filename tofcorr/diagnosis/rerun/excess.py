"""How far distances lie from what was measured, beyond the noise: sums over the poses."""

from dataclasses import dataclass

import torch
from torch import Tensor

from tofcorr.diagnosis.sums.observations import Observations


@dataclass(frozen=True, kw_only=True)
class Excess:
    """What the gap of any resample of the poses is computed from.

    Attributes:
        squares: Sum of a pose's weighted squares less those of the noise, shape (U,), m^2.
        weight: Sum of its weights, shape (U,).
    """

    squares: Tensor
    weight: Tensor

    @classmethod
    def of(
        cls, observations: Observations, left: Tensor, share: Tensor, noise: Tensor | float
    ) -> "Excess":
        """Sum up over the poses.

        Args:
            observations: The M pixels.
            left: Measured less expected, shape (M,), metres; what is not finite does not count.
            share: Weights, shape (M,).
            noise: Standard deviation of the pixels, shape (M,) or one number, metres.
        """
        share = share * left.isfinite()
        unit = observations.unit[observations.frame]
        none = torch.zeros(observations.num_units, dtype=torch.float64)
        squares = share * (left.nan_to_num(0.0, 0.0, 0.0) ** 2 - noise**2)
        return cls(squares=none.index_add(0, unit, squares), weight=none.index_add(0, unit, share))

    def gap(self) -> float:
        """Return the root mean square of all poses, metres; 0 where noise explains more."""
        return float(self.gaps(torch.ones_like(self.weight)[None]))

    def gaps(self, resamples: Tensor) -> Tensor:
        """Return the same of resamples, shape (B,), metres.

        Args:
            resamples: How often each resample holds each pose, shape (B, U).
        """
        mean = (resamples @ self.squares) / (resamples @ self.weight).clamp(min=1e-30)
        return mean.clamp(min=0.0).sqrt()
