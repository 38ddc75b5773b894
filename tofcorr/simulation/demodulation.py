"""From four correlation samples to phase, amplitude, offset and distance.

Equations 1 to 3 of Abdo and Borgeat (2010).
"""

import math
from typing import NamedTuple

import torch
from torch import Tensor

from tofcorr.geometry.ranges import unambiguous_range


class Demodulated(NamedTuple):
    """The result of four samples, each of shape (..., H, W).

    Attributes:
        phase: Radians in [0, 2 pi).
        amplitude: In the unit of the samples.
        offset: In the unit of the samples.
    """

    phase: Tensor
    amplitude: Tensor
    offset: Tensor


def demodulate(samples: Tensor) -> Demodulated:
    """Demodulate correlation samples A_k = offset + amplitude cos(phase + k pi / 2).

    phase = atan2(A3 - A1, A0 - A2), amplitude = sqrt((A3 - A1)^2 + (A0 - A2)^2) / 2,
    offset = (A0 + A1 + A2 + A3) / 4.

    Args:
        samples: A0..A3, shape (..., 4, H, W).
    """
    first, second, third, fourth = samples.unbind(-3)
    sine, cosine = fourth - second, first - third
    phase = torch.remainder(torch.atan2(sine, cosine), 2 * math.pi)
    return Demodulated(phase, torch.hypot(sine, cosine) / 2, samples.mean(-3))


def distance_from_phase(phase: Tensor, modulation_frequency: float) -> Tensor:
    """Return c phase / (4 pi f): radial distance in metres within the unambiguous range."""
    return phase * (unambiguous_range(modulation_frequency) / (2 * math.pi))
