r"""The probability that a pixel has no distance, as a function of its amplitude.

.. math:: P = b + (1 - b) / (1 + (A / A_{1/2})^{1/w})

b is the share that is missing however bright it is; darker than :math:`A_{1/2}` more than half is.
"""

import math
from dataclasses import asdict, dataclass
from typing import Any, TypeVar

import numpy as np
from torch import Tensor

ArrayT = TypeVar("ArrayT", np.ndarray, Tensor)

# Darkest amplitude as a share of the threshold: there every pixel is missing, and ln A is finite.
_DARKEST = 1e-6
# Odds against missing, as a logarithm, above which they grow no more, without unit. Derived: e^-80
# is below the rounding of float32, and e^80 is still a float32.
_SURE = 80.0


@dataclass(frozen=True, kw_only=True)
class DropoutModel:
    """Which pixels have no distance.

    Attributes:
        base_share: Share that is missing at any amplitude, 0 to 1.
        amplitude_at_half: Amplitude at which half of the others is missing, counts; None: no
            dependence on the amplitude was found, or no amplitude was recorded.
        width: Width of the transition, in ln A: from 73 % to 27 % missing within two widths.
        saturation_amplitude: Pixels at or above it are saturated, counts; None: none are.
    """

    base_share: float
    amplitude_at_half: float | None = None
    width: float = 0.1
    saturation_amplitude: float | None = None

    def probability(self, amplitude: ArrayT) -> ArrayT:
        """Return the probability that pixels of these amplitudes are missing; same shape.

        Saturated pixels are not missing by themselves: `saturation_amplitude` says which they are.
        """
        if self.amplitude_at_half is None:
            return amplitude * 0.0 + self.base_share
        relative = (amplitude / self.amplitude_at_half).clip(min=_DARKEST, max=self._brightest)
        dark = 1.0 / (1.0 + relative ** (1.0 / self.width))
        return self.base_share + (1.0 - self.base_share) * dark

    @property
    def _brightest(self) -> float:
        """The share of the threshold from which no pixel is missing; no power of it overflows."""
        return math.exp(_SURE * self.width)

    def to_dict(self) -> dict[str, Any]:
        """Return plain values, for YAML and JSON."""
        return asdict(self)
