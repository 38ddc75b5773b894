"""The circular error, periodic in the phase."""

import math
from typing import ClassVar, Literal

import torch
from pydantic import Field, PositiveInt
from torch import Tensor

from tofcorr.error_terms.base import BaseTermOptions, Domain, SignalTerm
from tofcorr.errors import CalibrationDataError
from tofcorr.geometry.rays import unambiguous_range


class PeriodicOptions(BaseTermOptions):
    """Options of `Periodic`.

    Attributes:
        harmonics: How many multiples of `fundamental` times the phase.
        fundamental: Periods over the unambiguous range: 4 with four samples a period.
    """

    kind: Literal["periodic"] = "periodic"
    harmonics: PositiveInt = Field(default=2, le=8)
    fundamental: PositiveInt = Field(default=4, le=16)
    needs: ClassVar[tuple[str, ...]] = ("modulation_frequency",)


class Periodic(SignalTerm):
    r"""Circular error ("wiggling"): sines and cosines of multiples of four times the phase.

    .. math:: D(\varphi) = \sum_{k=1}^{K} a_k \sin(4 k \varphi) + b_k \cos(4 k \varphi),
        \quad \varphi = 2 \pi D / U

    with U = c / 2f the unambiguous range. Four samples a period alias the light's odd overtones to
    the fundamental, which gives an error periodic in four times the phase (Lange 2000, "3D
    time-of-flight distance measurement with custom solid-state image sensors"; Kahlmann et al.
    2006). Any other dependence on distance, such as that of a wrong clock, needs a polynomial as
    well.

    Args:
        options: Number of harmonics.
        domain: Gives the modulation frequency.

    Raises:
        CalibrationDataError: The domain knows no modulation frequency.

    Shape:
        - Input: `(*)`, measured radial distances in metres (amplitudes are not read).
        - Output: `(*)`, predicted errors in metres.
    """

    wave_number: Tensor

    def __init__(self, options: PeriodicOptions, domain: Domain) -> None:
        if domain.modulation_frequency is None:
            raise CalibrationDataError(
                "The periodic term needs modulation_frequency_hz, which the recording does not "
                "state: add it to recording.yaml, or choose a spline."
            )
        orders = [options.fundamental * k for k in range(1, options.harmonics + 1)]
        names = [f"{function}{order}" for order in orders for function in ("sin", "cos")]
        super().__init__(options, "distance", names)
        self.harmonics: int = options.harmonics
        period = unambiguous_range(domain.modulation_frequency) / options.fundamental
        self.register_number("wave_number", 2.0 * math.pi / period)

    def basis(self, radial_distance: Tensor, amplitude: Tensor) -> Tensor:
        """Return sine and cosine of each harmonic, shape (2 K, ...)."""
        angle = radial_distance * self.wave_number
        functions = []
        for k in range(1, self.harmonics + 1):
            functions.append(torch.sin(k * angle))
            functions.append(torch.cos(k * angle))
        return torch.stack(functions)

    def forward(self, radial_distance: Tensor, amplitude: Tensor) -> Tensor:
        """Return the predicted error, shape (...), metres."""
        angle = radial_distance * self.wave_number
        total = torch.zeros_like(angle)
        for k in range(self.harmonics):
            turn = angle * (k + 1)
            total = total + self.coefficients[2 * k] * torch.sin(turn)
            total = total + self.coefficients[2 * k + 1] * torch.cos(turn)
        return total
