"""The error that depends on the place in the image, P."""

import math
from typing import ClassVar, Literal

from torch import Tensor, cat

from tofcorr.error_terms.base import PixelTerm
from tofcorr.error_terms.domain import Domain, Interval
from tofcorr.error_terms.polynomial import horner, powers, rescale, unit_of_power, unscale
from tofcorr.error_terms.term_options import BaseTermOptions
from tofcorr.options.numbers import Degree


class PixelPolynomialOptions(BaseTermOptions):
    """Options of `PixelPolynomial`."""

    kind: Literal["pixel_polynomial"] = "pixel_polynomial"
    degree: Degree = 2
    grows_with: ClassVar[str | None] = "degree"


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
        degree = options.degree
        names = [f"r^{k}" for k in range(1, degree + 1)] + [f"c^{k}" for k in range(1, degree + 1)]
        super().__init__(options, names)
        self.degree: int = degree
        rows, columns = Interval(0, domain.height - 1), Interval(0, domain.width - 1)
        self.register_number("row_centre", rows.centre)
        self.register_number("row_half", rows.half_width)
        self.register_number("column_centre", columns.centre)
        self.register_number("column_half", columns.half_width)

    def basis(self, rows: Tensor, columns: Tensor) -> Tensor:
        """Return the powers of the scaled row, then those of the column, shape (2 degree, ...)."""
        u = (rows - self.row_centre) / self.row_half
        v = (columns - self.column_centre) / self.column_half
        return cat([powers(u, self.degree), powers(v, self.degree)])

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
        row, column = self._scales()
        by_row = unscale(self.coefficients[: self.degree], *row)
        by_column = unscale(self.coefficients[self.degree :], *column)
        constant = by_row[0] + by_column[0]
        if self.degree == 1:
            return {"p1": by_row[1], "p2": by_column[1]}, constant
        if self.degree > 2:
            return dict(zip(self.symbols, by_row[1:] + by_column[1:], strict=True)), constant
        of_row, row_constant = _vertex_form(by_row, "p1", "r0")
        of_column, column_constant = _vertex_form(by_column, "p2", "c0")
        return of_row | of_column, constant + row_constant + column_constant

    def paper_units(self) -> dict[str, str]:
        """Return metres per pixel^k, and pixels for r0 and c0."""
        if self.degree > 2:
            orders = [*range(1, self.degree + 1)] * 2
            return {s: unit_of_power("pixel", k) for s, k in zip(self.symbols, orders, strict=True)}
        units = {name: unit_of_power("pixel", self.degree) for name in ("p1", "p2")}
        if self.degree == 2:
            units |= dict.fromkeys(("p1_linear", "p2_linear"), unit_of_power("pixel", 1))
            units |= dict.fromkeys(("r0", "c0"), "pixel")
        return units

    def set_paper_coefficients(self, values: dict[str, float]) -> float:
        """Set the paper's coefficients; return the constant they add, metres."""
        by_row, row_constant = _plain_form(values, self.degree, "p1", "r0", "r")
        by_column, column_constant = _plain_form(values, self.degree, "p2", "c0", "c")
        row, column = self._scales()
        scaled_row, extra_row = rescale(by_row, *row)
        scaled_column, extra_column = rescale(by_column, *column)
        self.coefficients.data.copy_(self.coefficients.new_tensor(scaled_row + scaled_column))
        return row_constant + column_constant + extra_row + extra_column

    def _scales(self) -> tuple[tuple[float, float], tuple[float, float]]:
        """Return centre and half-width of the rows, and of the columns."""
        row = (float(self.row_centre), float(self.row_half))
        return row, (float(self.column_centre), float(self.column_half))


def _vertex_form(plain: list[float], factor: str, vertex: str) -> tuple[dict[str, float], float]:
    """Turn b1 x + b2 x^2 into b2 (x - x0)^2; return it and the constant that remains."""
    _, linear, square = plain
    if square == 0.0:
        return {factor: 0.0, vertex: math.nan, f"{factor}_linear": linear}, 0.0
    x0 = -linear / (2 * square)
    return {factor: square, vertex: x0}, -square * x0 * x0


def _plain_form(
    values: dict[str, float], degree: int, factor: str, vertex: str, axis: str
) -> tuple[list[float], float]:
    """Return the coefficients of x, x^2, ... and a constant, from any form of the paper."""
    if degree == 1:
        return [values[factor]], 0.0
    if degree > 2:
        return [values[f"{axis}^{k}"] for k in range(1, degree + 1)], 0.0
    square, x0 = values[factor], values[vertex]
    if math.isnan(x0):
        return [values.get(f"{factor}_linear", 0.0), square], 0.0
    return [-2 * square * x0, square], square * x0 * x0
