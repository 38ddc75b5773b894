"""Polynomials: in the distance (D), in the amplitude (I), and in row and column (P)."""

import math
from functools import lru_cache
from typing import ClassVar, Literal

import torch
from numpy.polynomial import Polynomial
from torch import Tensor

from tofcorr.error_terms.base import (
    Axis,
    BaseTermOptions,
    CurveTerm,
    Domain,
    Interval,
    PixelTerm,
    ScaledPolynomial,
    Variable,
)
from tofcorr.options import Degree

# What the unit of each variable is called; a logarithm has none.
_UNITS = {"distance": "m", "amplitude": "amplitude", "normalised_amplitude": "(amplitude m^2)"}


def powers(scaled: Tensor, degree: int) -> Tensor:
    """Return u, u^2, ..., u^degree, shape (degree, ...)."""
    columns = [scaled]
    for _ in range(degree - 1):
        columns.append(columns[-1] * scaled)
    return torch.stack(columns)


def horner(coefficients: Tensor, scaled: Tensor) -> Tensor:
    """Return sum_k coefficients[k] u^(k+1), shape of `scaled`."""
    degree = coefficients.shape[0]
    value = scaled * coefficients[degree - 1]
    for k in range(degree - 2, -1, -1):
        value = (value + coefficients[k]) * scaled
    return value


def unscale(coefficients: Tensor, centre: float, half_width: float) -> list[float]:
    """Expand a polynomial in u = (x - centre) / half_width into powers of x.

    Args:
        coefficients: Coefficients of u, u^2, ..., shape (degree,).
        centre: Centre of the scaled variable, in units of x.
        half_width: Its half-width, in units of x.

    Returns:
        Coefficients of 1, x, x^2, ...: one more than were given.
    """
    line = _powers_of_line(-centre / half_width, 1.0 / half_width, len(coefficients) + 1)
    return (coefficients.detach().double().cpu() @ line[1:]).tolist()


def rescale(raw: list[float], centre: float, half_width: float) -> tuple[list[float], float]:
    """Turn coefficients of x, x^2, ... into those of u, u^2, ...: the inverse of `unscale`.

    Returns:
        The coefficients of u, u^2, ..., and the constant that remains.
    """
    line = _powers_of_line(centre, half_width, len(raw) + 1)
    constant, *scaled = (torch.tensor(raw, dtype=torch.float64) @ line[1:]).tolist()
    return scaled, constant


@lru_cache(maxsize=64)
def _powers_of_line(constant: float, slope: float, count: int) -> Tensor:
    """Return the coefficients of (constant + slope x)^k, k = 0, 1, ..., shape (count, count)."""
    line = Polynomial([constant, slope])
    rows = [(line**k).coef.tolist() for k in range(count)]
    return torch.tensor([row + [0.0] * (count - len(row)) for row in rows], dtype=torch.float64)


def unit_of_power(variable: str, power: int) -> str:
    """Return the unit of the coefficient of x^power in an error in metres, such as `m/pixel^2`."""
    return f"m/{variable}" if power == 1 else f"m/{variable}^{power}"


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
        letters = {"distance": "c", "log_amplitude": "l"}
        letter = letters.get(options.variable, "i")
        first = 3 if options.variable == "normalised_amplitude" else 1
        symbols = [f"{letter}{k}" for k in range(first, first + options.degree)]
        super().__init__(options, symbols, options.variable, domain)
        self.degree: int = options.degree

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
        return ScaledPolynomial(self.variable, self.coefficients, *self.scale())  # type: ignore[arg-type]

    def axes(self) -> tuple[Axis, ...] | None:
        """Return the logarithm of the amplitude; else the term is a polynomial anyway."""
        return (self.axis(1),) if self.variable == "log_amplitude" else None

    def paper_coefficients(self) -> tuple[dict[str, float], float]:
        """Return the coefficients of x, x^2, ... in metres per unit^k, and the constant left."""
        constant, *raw = unscale(self.coefficients, *self.scale())
        return dict(zip(self.symbols, raw, strict=True)), constant

    def paper_units(self) -> dict[str, str]:
        """Return metres per unit^k of the variable; a logarithm has no unit."""
        if self.variable not in _UNITS:
            return super().paper_units()
        unit = _UNITS[self.variable]
        return {symbol: unit_of_power(unit, k) for k, symbol in enumerate(self.symbols, start=1)}

    def set_paper_coefficients(self, values: dict[str, float]) -> float:
        """Set the paper's coefficients; return the constant they add, metres."""
        scaled, constant = rescale([values[symbol] for symbol in self.symbols], *self.scale())
        self.coefficients.data.copy_(self.coefficients.new_tensor(scaled))
        return constant


class PixelPolynomialOptions(BaseTermOptions):
    """Options of `PixelPolynomial`."""

    kind: Literal["pixel_polynomial"] = "pixel_polynomial"
    degree: Degree = 2


class PixelPolynomial(PixelTerm):
    r"""Polynomial in the row plus polynomial in the column.

    Degree 1 is P1 of Fuchs and May (2007), p1 r + p2 c. Degree 2 is P2 of Abdo and Borgeat
    (2010), p1 (r - r0)^2 + p2 (c - c0)^2, written as a polynomial, since r0 and
    c0 have no effect at p1 = p2 = 0. They are computed from its coefficients afterwards.

    Args:
        options: The degree.
        domain: The image size gives the scale: both edges lie at -1 and 1.

    Shape:
        - Input: `(*)` rows and `(*)` columns in pixels.
        - Output: `(*)`, predicted errors in metres.
    """

    row_centre: Tensor
    row_half: Tensor
    column_centre: Tensor
    column_half: Tensor

    def __init__(self, options: PixelPolynomialOptions, domain: Domain) -> None:
        orders = range(1, options.degree + 1)
        super().__init__(options, [f"{axis}^{k}" for axis in "rc" for k in orders])
        self.degree: int = options.degree
        for axis, size in (("row", domain.height), ("column", domain.width)):
            interval = Interval(0, size - 1)
            self.register_number(f"{axis}_centre", interval.centre)
            self.register_number(f"{axis}_half", interval.half_width)

    def basis(self, rows: Tensor, columns: Tensor) -> Tensor:
        """Return the powers of the scaled row, then those of the column, shape (2 degree, ...)."""
        u = (rows - self.row_centre) / self.row_half
        v = (columns - self.column_centre) / self.column_half
        return torch.cat([powers(u, self.degree), powers(v, self.degree)])

    def forward(self, rows: Tensor, columns: Tensor) -> Tensor:
        """Return the predicted error, shape (...), metres."""
        u = (rows - self.row_centre) / self.row_half
        v = (columns - self.column_centre) / self.column_half
        by_row = horner(self.coefficients[: self.degree], u)
        return by_row + horner(self.coefficients[self.degree :], v)

    def paper_coefficients(self) -> tuple[dict[str, float], float]:
        """Return p1, p2 (and r0, c0 at degree 2), and the constant that remains, metres.

        A direction without curvature has no vertex: r0 or c0 is then NaN, and the linear
        coefficient is given as p1_linear or p2_linear. Degrees above 2 are given as plain powers.
        """
        found: dict[str, float] = {}
        constant = 0.0
        parts = self.coefficients.split(self.degree)
        for part, scale, names in zip(parts, self._scales(), self._names(), strict=True):
            own, *plain = unscale(part, *scale)
            constant += own
            if self.degree != 2:
                found |= dict(zip(names, plain, strict=True))
                continue
            (factor, vertex), (linear, square) = names, plain
            if square == 0.0:
                found |= {factor: 0.0, vertex: math.nan, f"{factor}_linear": linear}
            else:  # b1 x + b2 x^2 = b2 (x - x0)^2 - b2 x0^2
                x0 = -linear / (2 * square)
                found |= {factor: square, vertex: x0}
                constant -= square * x0 * x0
        return found, constant

    def paper_units(self) -> dict[str, str]:
        """Return metres per pixel^k, and pixels for r0 and c0."""
        units: dict[str, str] = {}
        for names in self._names():
            if self.degree == 2:
                factor, vertex = names
                units |= {factor: unit_of_power("pixel", 2), vertex: "pixel"}
                units[f"{factor}_linear"] = unit_of_power("pixel", 1)
            else:
                units |= {name: unit_of_power("pixel", k) for k, name in enumerate(names, 1)}
        return units

    def set_paper_coefficients(self, values: dict[str, float]) -> float:
        """Set the paper's coefficients; return the constant they add, metres."""
        coefficients: list[float] = []
        constant = 0.0
        for scale, names in zip(self._scales(), self._names(), strict=True):
            plain = [values[name] for name in names]
            if self.degree == 2:
                square, x0 = plain
                if math.isnan(x0):
                    plain = [values.get(f"{names[0]}_linear", 0.0), square]
                else:
                    plain = [-2 * square * x0, square]
                    constant += square * x0 * x0
            scaled, own = rescale(plain, *scale)
            coefficients += scaled
            constant += own
        self.coefficients.data.copy_(self.coefficients.new_tensor(coefficients))
        return constant

    def _scales(self) -> tuple[tuple[float, float], tuple[float, float]]:
        """Return centre and half-width of the rows, and of the columns."""
        row = (float(self.row_centre), float(self.row_half))
        return row, (float(self.column_centre), float(self.column_half))

    def _names(self) -> list[list[str]]:
        """Return the paper's symbols of the rows, and of the columns."""
        forms = {1: [["p1"], ["p2"]], 2: [["p1", "r0"], ["p2", "c0"]]}
        return forms.get(self.degree, [self.symbols[: self.degree], self.symbols[self.degree :]])
