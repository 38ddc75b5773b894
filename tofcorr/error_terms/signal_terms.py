"""Smooth functions of the measurement: polynomials, and the circular error of the phase."""

import math
from typing import ClassVar, Literal

import torch
from pydantic import Field, PositiveInt
from torch import Tensor

from tofcorr.error_terms.base import (
    Axis,
    BaseTermOptions,
    CurveTerm,
    Domain,
    ScaledPolynomial,
    SignalTerm,
    Variable,
    axis_of,
    powers,
)
from tofcorr.errors import CalibrationDataError
from tofcorr.geometry.rays import unambiguous_range
from tofcorr.options import Degree


class DistancePolynomialOptions(BaseTermOptions):
    """Options of a `SignalPolynomial` in the distance."""

    kind: Literal["distance_polynomial"] = "distance_polynomial"
    degree: Degree = 3
    variable: ClassVar[Variable] = "distance"


class AmplitudePolynomialOptions(BaseTermOptions):
    """Options of a `SignalPolynomial` in the amplitude."""

    kind: Literal["amplitude_polynomial"] = "amplitude_polynomial"
    variable: Literal["amplitude", "normalised_amplitude", "log_amplitude"] = "amplitude"
    degree: Degree = 2
    needs: ClassVar[tuple[str, ...]] = ("amplitude",)


# By variable: the letter of its coefficients, the number of the first, and the unit of the variable
# ("": none).
_NAMES: dict[str, tuple[str, int, str]] = {
    "distance": ("c", 1, "m"),
    "amplitude": ("i", 1, "amplitude"),
    "normalised_amplitude": ("i", 3, "(amplitude m^2)"),
    "log_amplitude": ("l", 1, ""),
}


class SignalPolynomial(CurveTerm):
    r"""Polynomial in one variable of the signal.

    .. math:: E(u) = \sum_{k=1}^{K} c'_k u^k, \quad u = (x - \bar x) / h

    With x the measured radial distance it is D of Abdo and Borgeat (2010): cubic, below 2 m. With
    the amplitude I, or the distance-normalised one N = I D^2, it is their I1 and I2. The literature
    calls it intensity-related; what it depends on is the amplitude of the modulated part, not the
    total light.

    Args:
        options: The variable and the degree K.
        domain: The range of the variable gives the centre and the half-width h.

    Raises:
        CalibrationDataError: The domain does not know the variable.

    Shape:
        - Input: `(*)`, radial distances in metres, and `(*)`, amplitudes in the camera's units.
        - Output: `(*)`, predicted errors in metres.

    Example:
        >>> import torch
        >>> from tofcorr.error_terms.base import Domain, Interval
        >>> domain = Domain(height=4, width=4, radial_distance=Interval(1.0, 3.0))
        >>> term = SignalPolynomial(DistancePolynomialOptions(degree=1), domain)
        >>> _ = term.coefficients.data.fill_(0.01)
        >>> distance = torch.tensor([1.0, 2.0, 3.0], dtype=torch.float64)
        >>> term(distance, distance).tolist()
        [-0.01, 0.0, 0.01]
    """

    def __init__(
        self, options: DistancePolynomialOptions | AmplitudePolynomialOptions, domain: Domain
    ) -> None:
        letter, first, _ = _NAMES[options.variable]
        symbols = [f"{letter}{k}" for k in range(first, first + options.degree)]
        super().__init__(options, symbols, options.variable, domain)
        self.degree: int = options.degree

    def basis(self, radial_distance: Tensor, amplitude: Tensor) -> Tensor:
        """Return u, u^2, ..., shape (K, ...)."""
        return powers(self.scaled(radial_distance, amplitude), self.degree)

    def forward(self, radial_distance: Tensor, amplitude: Tensor) -> Tensor:
        """Return the predicted error, shape (...), metres: by Horner's rule."""
        scaled = self.scaled(radial_distance, amplitude)
        value = scaled * self.coefficients[self.degree - 1]
        for k in range(self.degree - 2, -1, -1):
            value = (value + self.coefficients[k]) * scaled
        return value

    def polynomial(self) -> ScaledPolynomial | None:
        """Return the term as a polynomial; None for the logarithm, which no other term shares."""
        if self.variable == "log_amplitude":
            return None
        return ScaledPolynomial(self.variable, self.coefficients, *self.scale())  # type: ignore[arg-type]

    def axes(self) -> tuple[Axis, ...] | None:
        """Return the logarithm of the amplitude; else the term is a polynomial anyway."""
        if self.variable != "log_amplitude":
            return None
        return (axis_of(self.variable, self.centre, self.half_width, 1),)

    def paper_coefficients(self) -> tuple[dict[str, tuple[float, str]], float]:
        """Return the coefficients of x, x^2, ... in metres per unit^k, and the constant left."""
        constant, *raw = unscale(self.coefficients, *self.scale())
        unit = _NAMES[self.variable][2]  # A logarithm has none.
        units = [unit_of_power(unit, k) if unit else "m" for k in range(1, self.degree + 1)]
        return dict(zip(self.symbols, zip(raw, units, strict=True), strict=True)), constant

    def set_paper_coefficients(self, values: dict[str, float]) -> float:
        """Set the paper's coefficients; return the constant they add, metres."""
        scaled, constant = rescale([values[symbol] for symbol in self.symbols], *self.scale())
        self.set_coefficients(scaled)
        return constant


def unscale(coefficients: Tensor, centre: float, half_width: float) -> list[float]:
    """Expand a polynomial in u = (x - centre) / half_width into powers of x.

    Args:
        coefficients: Coefficients of u, u^2, ..., shape (degree,).
        centre: Centre of the scaled variable, in units of x.
        half_width: Its half-width, in units of x.

    Returns:
        Coefficients of 1, x, x^2, ...: one more than were given.
    """
    terms = list(enumerate([0.0, *coefficients.detach().double().cpu().tolist()]))
    slope, start = 1.0 / half_width, -centre / half_width
    return [
        slope**k * sum(own * math.comb(n, k) * start ** (n - k) for n, own in terms[k:])
        for k, _ in terms
    ]


def rescale(raw: list[float], centre: float, half_width: float) -> tuple[list[float], float]:
    """Turn coefficients of x, x^2, ... into those of u, u^2, ...: the inverse of `unscale`.

    Returns:
        The coefficients of u, u^2, ..., and the constant that remains.
    """
    # x is a scaled variable of u: its centre and half-width are those of u seen from x.
    given = torch.tensor(raw, dtype=torch.float64)
    constant, *scaled = unscale(given, -centre / half_width, 1 / half_width)
    return scaled, constant


def unit_of_power(variable: str, power: int) -> str:
    """Return the unit of the coefficient of x^power in an error in metres, such as `m/pixel^2`."""
    return f"m/{variable}" if power == 1 else f"m/{variable}^{power}"


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
            raise CalibrationDataError("periodic needs modulation_frequency_hz in recording.yaml.")
        orders = [options.fundamental * k for k in range(1, options.harmonics + 1)]
        names = [f"{function}{order}" for order in orders for function in ("sin", "cos")]
        super().__init__(options, "distance", names)
        self.harmonics: int = options.harmonics
        period = unambiguous_range(domain.modulation_frequency) / options.fundamental
        self.register_number("wave_number", 2 * math.pi / period)

    def basis(self, radial_distance: Tensor, amplitude: Tensor) -> Tensor:
        """Return sine and cosine of each harmonic, shape (2 K, ...)."""
        functions = []
        for k in range(1, self.harmonics + 1):
            angle = radial_distance * (k * self.wave_number)
            functions += [torch.sin(angle), torch.cos(angle)]
        return torch.stack(functions)
