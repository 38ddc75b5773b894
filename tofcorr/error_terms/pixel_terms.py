"""The error over the image: polynomials of row and column, and an offset for each pixel."""

import math
from typing import ClassVar, Literal

import torch
from pydantic import PositiveFloat
from torch import Tensor

from tofcorr.error_terms.base import BaseTermOptions, Domain, Interval, PixelMap, PixelTerm, powers
from tofcorr.error_terms.signal_terms import rescale, unit_of_power, unscale
from tofcorr.options import Degree


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
        super().__init__(options, "pixel", [f"{axis}^{k}" for axis in "rc" for k in orders])
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

    def paper_coefficients(self) -> tuple[dict[str, tuple[float, str]], float]:
        """Return p1, p2 (and r0, c0 at degree 2) with their units, and the constant left, metres.

        A direction without curvature has no vertex: r0 or c0 is then NaN, and the linear
        coefficient is given as p1_linear or p2_linear. Degrees above 2 are given as plain powers.
        """
        found: dict[str, tuple[float, str]] = {}
        constant = 0.0
        parts = self.coefficients.split(self.degree)
        for part, (names, *scale) in zip(parts, self._axes(), strict=True):
            own, *plain = unscale(part, *scale)
            constant += own
            for k, (name, value) in enumerate(zip(names, plain, strict=True), 1):
                found[name] = value, unit_of_power("pixel", k)
            if self.degree == 2:  # b1 x + b2 x^2 = b2 (x - x0)^2 - b2 x0^2
                linear, square = plain
                x0 = -linear / (2 * square) if square else math.nan
                found |= {names[0]: (square, unit_of_power("pixel", 2)), names[1]: (x0, "pixel")}
                if square:
                    constant -= square * x0 * x0
                else:
                    found[f"{names[0]}_linear"] = linear, unit_of_power("pixel", 1)
        return found, constant

    def set_paper_coefficients(self, values: dict[str, float]) -> float:
        """Set the paper's coefficients; return the constant they add, metres."""
        coefficients: list[float] = []
        constant = 0.0
        for names, *scale in self._axes():
            plain = [values[name] for name in names]
            if self.degree == 2:
                square, x0 = plain
                flat = math.isnan(x0)
                constant += 0.0 if flat else square * x0 * x0
                linear = values.get(f"{names[0]}_linear", 0.0) if flat else -2 * square * x0
                plain = [linear, square]
            scaled, own = rescale(plain, *scale)
            coefficients += scaled
            constant += own
        self.set_coefficients(coefficients)
        return constant

    def _axes(self) -> list[tuple[list[str], float, float]]:
        """Return the paper's symbols, centre and half-width of the rows, and of the columns."""
        forms = {1: [["p1"], ["p2"]], 2: [["p1", "r0"], ["p2", "c0"]]}
        names = forms.get(self.degree, [self.symbols[: self.degree], self.symbols[self.degree :]])
        return [
            (names[0], float(self.row_centre), float(self.row_half)),
            (names[1], float(self.column_centre), float(self.column_half)),
        ]


class FixedPatternOptions(BaseTermOptions):
    """Options of `FixedPattern`.

    Attributes:
        spread_mm: Standard deviation of the pixels' offsets; `auto` estimates it.
    """

    kind: Literal["fixed_pattern"] = "fixed_pattern"
    spread_mm: Literal["auto"] | PositiveFloat = "auto"
    found_in_data: ClassVar[tuple[str, ...]] = ("spread_mm",)
    has_columns: ClassVar[bool] = False


class FixedPattern(PixelMap):
    """One offset a pixel: the fixed-pattern matrix of Kahlmann, Remondino and Ingensand (2006).

    It has no coefficients: each pixel's offset is estimated from its residuals to the fitted terms,
    and shrunk towards zero.

    Args:
        options: How much the offsets are shrunk.
        domain: The image size.
    """
