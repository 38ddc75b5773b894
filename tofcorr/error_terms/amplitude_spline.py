"""The error that depends on the strength of the signal, as a curve through knots."""

from typing import ClassVar, Literal

from pydantic import Field, NonNegativeFloat
from torch import Tensor

from tofcorr.error_terms.axis import Axis
from tofcorr.error_terms.base import SignalTerm
from tofcorr.error_terms.domain import Domain
from tofcorr.error_terms.log_amplitude import amplitude_floor, log_amplitude, log_interval
from tofcorr.error_terms.spline import (
    second_differences,
    spline_basis,
    spline_size,
    spline_value,
    with_middle,
    without_middle,
)
from tofcorr.error_terms.term_options import BaseTermOptions


class IncidentLightOptions(BaseTermOptions):
    """Options of `IncidentLight`.

    Attributes:
        segments: Pieces over the calibrated range of log amplitude.
        strength: Weight of the integrated squared curvature against the mean squared residual.
    """

    kind: Literal["incident_light"] = "incident_light"
    segments: int = Field(default=6, ge=2, le=100)
    strength: Literal["auto"] | NonNegativeFloat = "auto"
    needs: ClassVar[tuple[str, ...]] = ("amplitude",)
    found_in_data: ClassVar[tuple[str, ...]] = ("strength",)


class IncidentLight(SignalTerm):
    r"""Curve over the logarithm of the amplitude, the light that comes back to the pixel.

    .. math:: I(u) = \sum_{k \ne m} a_k B_k(u), \quad u = (\ln I - \bar l) / h

    Radmer, Fuste, Schmidt and Krueger (2008), "Incident light related distance error study and
    calibration of the PMD-range imaging camera", found the error to follow the light that reaches
    the pixel, at a given distance. We use cubic B-splines over the
    logarithm, so that each decade between dark and bright targets has its own pieces.

    Args:
        options: Number of pieces and strength of the penalty.
        domain: The range of amplitudes gives the knots.

    Raises:
        CalibrationDataError: The domain knows no amplitudes.

    Shape:
        - Input: `(*)`, radial distances (not read), and `(*)`, amplitudes in the camera's
          units.
        - Output: `(*)`, predicted errors in metres.
    """

    centre: Tensor
    half_width: Tensor
    floor: Tensor

    def __init__(self, options: IncidentLightOptions, domain: Domain) -> None:
        size = spline_size(options.segments, 3)
        kept = [k for k in range(size) if k != size // 2]
        super().__init__(options, "intensity", [f"a{options.segments}.{k}" for k in kept])
        interval = log_interval(domain)
        self.segments: int = options.segments
        self.register_number("centre", interval.centre)
        self.register_number("half_width", interval.half_width)
        self.register_number("floor", amplitude_floor(domain))

    def scaled(self, amplitude: Tensor) -> Tensor:
        """Return the scaled logarithm u, shape (...)."""
        return (log_amplitude(amplitude, self.floor) - self.centre) / self.half_width

    def basis(self, radial_distance: Tensor, amplitude: Tensor) -> Tensor:
        """Return the B-splines but the middle one, shape (K, ...)."""
        return without_middle(spline_basis(self.scaled(amplitude), self.segments, 3))

    def forward(self, radial_distance: Tensor, amplitude: Tensor) -> Tensor:
        """Return the predicted error, shape (...), metres."""
        full = with_middle(self.coefficients)
        return spline_value(full, self.scaled(amplitude), self.segments, 3)

    def axes(self) -> tuple[Axis, ...]:
        """Return the logarithm of the amplitude, with the knots."""
        half_width = float(self.half_width)
        return (Axis.around("log_amplitude", float(self.centre), half_width, self.segments),)

    def roughness(self) -> Tensor:
        """Return second differences, shape (K - 1, K)."""
        size = spline_size(self.segments, 3)
        return without_middle(second_differences(size, self.segments).T).T
