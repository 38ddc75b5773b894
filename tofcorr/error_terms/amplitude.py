"""The error that depends on the strength of the signal, I.

The literature calls it intensity-related; what it depends on is the amplitude of the modulated
part, not the total light.
"""

from typing import ClassVar, Literal

from torch import Tensor

from tofcorr.error_terms.axis import Axis
from tofcorr.error_terms.base import SignalTerm
from tofcorr.error_terms.domain import Domain, Interval
from tofcorr.error_terms.log_amplitude import (
    amplitude_floor,
    known_amplitude,
    log_amplitude,
    log_interval,
)
from tofcorr.error_terms.polynomial import (
    ScaledPolynomial,
    horner,
    powers,
    rescale,
    unit_of_power,
    unscale,
)
from tofcorr.error_terms.term_options import BaseTermOptions
from tofcorr.options.numbers import Degree

Variable = Literal["amplitude", "normalised_amplitude", "log_amplitude"]


class AmplitudePolynomialOptions(BaseTermOptions):
    """Options of `AmplitudePolynomial`."""

    kind: Literal["amplitude_polynomial"] = "amplitude_polynomial"
    variable: Variable = "amplitude"
    degree: Degree = 2
    needs: ClassVar[tuple[str, ...]] = ("amplitude",)
    grows_with: ClassVar[str | None] = "degree"


class AmplitudePolynomial(SignalTerm):
    r"""Polynomial in the amplitude: I1 and I2 of Abdo and Borgeat (2010).

    .. math:: I(u) = \sum_{k=1}^{K} i'_k u^k

    with u the centred and scaled amplitude I (I1), distance-normalised amplitude N = I D^2 (I2),
    or logarithm of the amplitude.

    Args:
        options: The variable and the degree K.
        domain: The ranges give centre and half-width.

    Raises:
        CalibrationDataError: The domain knows no amplitudes.

    Shape:
        - Input: `(*)`, radial distances in metres, and `(*)`, amplitudes in the camera's units.
        - Output: `(*)`, predicted errors in metres.
    """

    centre: Tensor
    half_width: Tensor
    floor: Tensor

    def __init__(self, options: AmplitudePolynomialOptions, domain: Domain) -> None:
        first = {"amplitude": 1, "normalised_amplitude": 3, "log_amplitude": 1}[options.variable]
        prefix = "l" if options.variable == "log_amplitude" else "i"
        symbols = [f"{prefix}{k}" for k in range(first, first + options.degree)]
        super().__init__(options, "intensity", symbols)
        self.uses_normalised_amplitude = options.variable == "normalised_amplitude"
        self.degree: int = options.degree
        self.variable: str = options.variable
        interval = _interval(options.variable, domain)
        self.register_number("centre", interval.centre)
        self.register_number("half_width", interval.half_width)
        self.register_number("floor", amplitude_floor(domain))

    def scaled(self, radial_distance: Tensor, amplitude: Tensor) -> Tensor:
        """Return the scaled variable u, shape (...)."""
        value = amplitude
        if self.variable == "normalised_amplitude":
            value = amplitude * radial_distance * radial_distance
        if self.variable == "log_amplitude":
            value = log_amplitude(amplitude, self.floor)
        return (value - self.centre) / self.half_width

    def basis(self, radial_distance: Tensor, amplitude: Tensor) -> Tensor:
        """Return u, u^2, ..., shape (K, ...)."""
        return powers(self.scaled(radial_distance, amplitude), self.degree)

    def forward(self, radial_distance: Tensor, amplitude: Tensor) -> Tensor:
        """Return the predicted error, shape (...), metres."""
        return horner(self.coefficients, self.scaled(radial_distance, amplitude))

    def polynomial(self) -> ScaledPolynomial | None:
        """Return the term as a polynomial; None for the logarithm, which no other term shares."""
        if self.variable == "log_amplitude":
            return None
        return ScaledPolynomial(
            "normalised_amplitude" if self.uses_normalised_amplitude else "amplitude",
            self.coefficients,
            float(self.centre),
            float(self.half_width),
        )

    def axes(self) -> tuple[Axis, ...] | None:
        """Return the logarithm of the amplitude; else the term is a polynomial anyway."""
        if self.variable != "log_amplitude":
            return None
        return (Axis.around("log_amplitude", float(self.centre), float(self.half_width)),)

    def paper_coefficients(self) -> tuple[dict[str, float], float]:
        """Return i1, i2 (or i3, i4) in metres per unit^k, and the constant that remains."""
        constant, *raw = unscale(self.coefficients, float(self.centre), float(self.half_width))
        return dict(zip(self.symbols, raw, strict=True)), constant

    def paper_units(self) -> dict[str, str]:
        """Return metres per unit^k of the variable; a logarithm has no unit."""
        unit = {"amplitude": "amplitude", "normalised_amplitude": "(amplitude m^2)"}
        if self.variable not in unit:
            return super().paper_units()
        powers_of = enumerate(self.symbols, start=1)
        return {symbol: unit_of_power(unit[self.variable], k) for k, symbol in powers_of}

    def set_paper_coefficients(self, values: dict[str, float]) -> float:
        """Set the paper's coefficients; return the constant they add, metres."""
        raw = [values[symbol] for symbol in self.symbols]
        scaled, constant = rescale(raw, float(self.centre), float(self.half_width))
        self.coefficients.data.copy_(self.coefficients.new_tensor(scaled))
        return constant


def _interval(variable: Variable, domain: Domain) -> Interval:
    amplitude = known_amplitude(domain)
    if variable == "log_amplitude":
        return log_interval(domain)
    if variable == "normalised_amplitude" and domain.normalised_amplitude is not None:
        return domain.normalised_amplitude
    return amplitude
