"""The error that depends on distance alone, as a curve through knots."""

from typing import ClassVar, Literal, NamedTuple

from pydantic import Field, NonNegativeFloat
from torch import Tensor

from tofcorr.error_terms.axis import Axis
from tofcorr.error_terms.base import SignalTerm
from tofcorr.error_terms.domain import Domain
from tofcorr.error_terms.spline import (
    second_differences,
    spline_basis,
    spline_size,
    spline_value,
    with_middle,
    without_middle,
)
from tofcorr.error_terms.term_options import BaseTermOptions


class Pieces(NamedTuple):
    """The degree of a spline's pieces, and the letter its symbols begin with."""

    degree: int
    letter: str


class DistanceSplineOptions(BaseTermOptions):
    """Options of `DistanceSpline` with cubic pieces.

    Attributes:
        segments: Pieces over the calibrated range of distances.
        strength: Weight of the integrated squared curvature against the mean squared residual.
    """

    kind: Literal["distance_spline"] = "distance_spline"
    segments: int = Field(default=24, ge=2, le=100)
    strength: Literal["auto"] | NonNegativeFloat = "auto"
    found_in_data: ClassVar[tuple[str, ...]] = ("strength",)
    pieces: ClassVar[Pieces] = Pieces(3, "s")


class LookupTableOptions(BaseTermOptions):
    """Options of `DistanceSpline` with linear pieces: a table with interpolation.

    Attributes:
        segments: Intervals between the table's entries, over the calibrated range of distances.
        strength: Weight of the table's roughness against the mean squared residual.
    """

    kind: Literal["lookup_table"] = "lookup_table"
    segments: int = Field(default=48, ge=2, le=200)
    strength: Literal["auto"] | NonNegativeFloat = "auto"
    found_in_data: ClassVar[tuple[str, ...]] = ("strength",)
    pieces: ClassVar[Pieces] = Pieces(1, "l")


class DistanceSpline(SignalTerm):
    r"""Curve over the measured radial distance, made of B-splines.

    .. math:: D(u) = \sum_{k \ne m} c_k B_k(u), \quad u = (D - \bar D) / h

    Cubic: Lindner and Kolb (2006), "Lateral and depth calibration of PMD-distance sensors".
    Linear: the look-up table over distance of Kahlmann, Remondino and Ingensand (2006),
    "Calibration for increased accuracy of the range imaging camera SwissRanger"; their matrix of
    pixels is the term `fixed_pattern`. The function m in the middle is omitted, since the error
    model has a constant. Roughness is penalised as in P-splines (Eilers and Marx 1996).

    Args:
        options: Number of pieces and strength of the penalty.
        domain: The range of distances gives the knots.

    Shape:
        - Input: `(*)`, measured radial distances in metres (amplitudes are not read).
        - Output: `(*)`, predicted errors in metres.
    """

    centre: Tensor
    half_width: Tensor

    def __init__(self, options: DistanceSplineOptions | LookupTableOptions, domain: Domain) -> None:
        degree, letter = options.pieces
        size = spline_size(options.segments, degree)
        kept = [k for k in range(size) if k != size // 2]
        super().__init__(options, "distance", [f"{letter}{options.segments}.{k}" for k in kept])
        self.degree: int = degree
        self.segments: int = options.segments
        self.register_number("centre", domain.radial_distance.centre)
        self.register_number("half_width", domain.radial_distance.half_width)

    def basis(self, radial_distance: Tensor, amplitude: Tensor) -> Tensor:
        """Return the B-splines but the middle one, shape (K, ...)."""
        scaled = (radial_distance - self.centre) / self.half_width
        return without_middle(spline_basis(scaled, self.segments, self.degree))

    def forward(self, radial_distance: Tensor, amplitude: Tensor) -> Tensor:
        """Return the predicted error, shape (...), metres."""
        scaled = (radial_distance - self.centre) / self.half_width
        return spline_value(with_middle(self.coefficients), scaled, self.segments, self.degree)

    def axes(self) -> tuple[Axis, ...]:
        """Return the distance, with the knots."""
        half_width = float(self.half_width)
        return (Axis.around("distance", float(self.centre), half_width, self.segments),)

    def roughness(self) -> Tensor:
        """Return second differences, shape (K - 1, K)."""
        size = spline_size(self.segments, self.degree)
        return without_middle(second_differences(size, self.segments).T).T
