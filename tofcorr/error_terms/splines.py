"""Curves and a surface through knots: B-splines of the distance, the amplitude, or both."""

import math
from abc import abstractmethod
from typing import ClassVar, Literal

import torch
from pydantic import Field, NonNegativeFloat
from torch import Tensor

from tofcorr.error_terms.base import (
    Axis,
    BaseTermOptions,
    CurveTerm,
    Domain,
    SignalTerm,
    Variable,
    axis_of,
    variable_of,
)


def spline_weights(scaled: Tensor, segments: int, degree: int) -> tuple[Tensor, list[Tensor]]:
    """Return the first of the degree + 1 splines that are not zero, and their values.

    Args:
        scaled: The variable, scaled to [-1, 1], shape (...); NaN gives values of NaN.
        segments: Number of segments.
        degree: 1 or 3.
    """
    # Knots lie at 0, 1, .., segments.
    x = (scaled.clamp(-1.0, 1.0) + 1.0) * (0.5 * segments)
    first = x.nan_to_num(0.0).floor().clamp(0.0, float(segments - 1)).to(torch.int64)
    f = x - first
    g = 1.0 - f
    if degree == 1:
        return first, [g, f]
    square, other = f * f, g * g
    inner = 3.0 * (f - 2.0) * square + 4.0
    mirrored = 3.0 * (g - 2.0) * other + 4.0
    return first, [value / 6 for value in [g * other, inner, mirrored, f * square]]


def placed(positions: list[Tensor], weights: list[Tensor], size: int) -> Tensor:
    """Return all functions, shape (size, ...), of which those at some positions are not zero."""
    functions = torch.zeros([size] + list(weights[0].shape)).to(weights[0])  # noqa: RUF005
    for k in range(len(positions)):
        functions = functions.scatter(0, positions[k].unsqueeze(0), weights[k].unsqueeze(0))
    return functions


def with_middle(coefficients: Tensor) -> Tensor:
    """Return the coefficients of all splines, with zero for the omitted one in the middle."""
    middle = (coefficients.shape[0] + 1) // 2
    zero = torch.zeros(1, dtype=coefficients.dtype, device=coefficients.device)
    return torch.cat([coefficients[:middle], zero, coefficients[middle:]])


def without_middle(values: Tensor) -> Tensor:
    """Omit the middle entry along the first dimension; inverse of `with_middle`."""
    middle = values.shape[0] // 2
    return torch.cat([values[:middle], values[middle + 1 :]])


def second_differences(size: int, segments: int) -> Tensor:
    """Return rows whose squared product with spline coefficients is the integrated curvature.

    The P-spline penalty of Eilers and Marx (1996): second differences of neighbouring
    coefficients, scaled so that the sum of their squares is about the integral of the squared
    second derivative over the interval mapped to [0, 1], for any number of segments.
    """
    rows = torch.diff(torch.eye(size, dtype=torch.float64), n=2, dim=0)
    return rows * segments**1.5


class SplineOptions(BaseTermOptions):
    """What the options of all splines share.

    Attributes:
        strength: Weight of the integrated squared curvature, along all axes, against the mean
            squared residual.
    """

    strength: Literal["auto"] | NonNegativeFloat = "auto"
    found_in_data: ClassVar[tuple[str, ...]] = ("strength",)


class DistanceSplineOptions(SplineOptions):
    """Options of a `SignalSpline` over the distance with cubic pieces.

    Attributes:
        segments: Pieces over the calibrated range of distances.
    """

    kind: Literal["distance_spline"] = "distance_spline"
    segments: int = Field(default=24, ge=2, le=100)
    variable: ClassVar[Variable] = "distance"
    degree: ClassVar[int] = 3
    letter: ClassVar[str] = "s"


class LookupTableOptions(SplineOptions):
    """Options of a `SignalSpline` with linear pieces: a table with interpolation.

    Attributes:
        segments: Intervals between the table's entries, over the calibrated range of distances.
    """

    kind: Literal["lookup_table"] = "lookup_table"
    segments: int = Field(default=48, ge=2, le=200)
    variable: ClassVar[Variable] = "distance"
    degree: ClassVar[int] = 1
    letter: ClassVar[str] = "l"


class IncidentLightOptions(SplineOptions):
    """Options of a `SignalSpline` over the logarithm of the amplitude.

    Attributes:
        segments: Pieces over the calibrated range of log amplitude.
    """

    kind: Literal["incident_light"] = "incident_light"
    segments: int = Field(default=6, ge=2, le=100)
    needs: ClassVar[tuple[str, ...]] = ("amplitude",)
    variable: ClassVar[Variable] = "log_amplitude"
    degree: ClassVar[int] = 3
    letter: ClassVar[str] = "a"


Nonzero = tuple[list[Tensor], list[Tensor]]
"""The numbers of the functions that are not zero somewhere, and their values."""


class SplineTerm(SignalTerm):
    """A sum of splines, or of their products, of which few are not zero at any place."""

    @abstractmethod
    def nonzero(self, radial_distance: Tensor, amplitude: Tensor) -> Nonzero:
        """Return the numbers of the functions that are not zero, and their values, each (...)."""

    def basis(self, radial_distance: Tensor, amplitude: Tensor) -> Tensor:
        """Return the functions but the middle one, shape (K, ...)."""
        positions, weights = self.nonzero(radial_distance, amplitude)
        return without_middle(placed(positions, weights, self.coefficients.shape[0] + 1))

    def forward(self, radial_distance: Tensor, amplitude: Tensor) -> Tensor:
        """Return the predicted error, shape (...), metres: from the functions not zero."""
        full = with_middle(self.coefficients)
        positions, weights = self.nonzero(radial_distance, amplitude)
        value = weights[0] * full[positions[0]]
        for k in range(1, len(weights)):
            value = value + weights[k] * full[positions[k]]
        return value


class SignalSpline(SplineTerm, CurveTerm):
    r"""Curve over one variable of the signal, made of B-splines.

    .. math:: E(u) = \sum_{k \ne m} c_k B_k(u), \quad u = (x - \bar x) / h

    Cubic in the distance: Lindner and Kolb (2006), "Lateral and depth calibration of PMD-distance
    sensors". Linear: the look-up table over distance of Kahlmann, Remondino and Ingensand (2006),
    "Calibration for increased accuracy of the range imaging camera SwissRanger"; their matrix of
    pixels is the term `fixed_pattern`. Over the logarithm of the amplitude: Radmer, Fuste, Schmidt
    and Krueger (2008), "Incident light related distance error study and calibration of the
    PMD-range imaging camera", found the error to follow the light that reaches the pixel, at a
    given distance; over the logarithm each decade between dark and bright targets has its own
    pieces. The function m in the middle is omitted, since the error model has a constant.
    Roughness is penalised as in P-splines (Eilers and Marx 1996).

    Args:
        options: Variable, degree and number of pieces, and strength of the penalty.
        domain: The range of the variable gives the knots.

    Raises:
        CalibrationDataError: The domain does not know the variable.

    Shape:
        - Input: `(*)`, radial distances in metres, and `(*)`, amplitudes in the camera's units.
        - Output: `(*)`, predicted errors in metres.
    """

    def __init__(
        self,
        options: DistanceSplineOptions | LookupTableOptions | IncidentLightOptions,
        domain: Domain,
    ) -> None:
        size = options.segments + options.degree
        symbols = [f"{options.letter}{options.segments}.{k}" for k in range(size)]
        del symbols[size // 2]
        super().__init__(options, symbols, options.variable, domain)
        self.degree: int = options.degree
        self.segments: int = options.segments

    def nonzero(self, radial_distance: Tensor, amplitude: Tensor) -> Nonzero:
        """Return the B-splines that are not zero."""
        scaled = self.scaled(radial_distance, amplitude)
        first, weights = spline_weights(scaled, self.segments, self.degree)
        return [first + k for k in range(self.degree + 1)], weights

    def axes(self) -> tuple[Axis, ...]:
        """Return the variable, with the knots."""
        return (axis_of(self.variable, self.centre, self.half_width, self.segments),)

    def roughness(self) -> Tensor:
        """Return second differences, shape (K - 1, K)."""
        rows = second_differences(self.segments + self.degree, self.segments)
        return without_middle(rows.T).T


class TensorSplineOptions(SplineOptions):
    """Options of `TensorSpline`.

    Attributes:
        distance_segments: Pieces over the calibrated range of distances.
        amplitude_segments: Pieces over the calibrated range of amplitudes.
        axis: Whether the amplitude's pieces are equal in its logarithm or in itself.
    """

    kind: Literal["tensor_spline"] = "tensor_spline"
    distance_segments: int = Field(default=5, ge=1, le=40)
    amplitude_segments: int = Field(default=3, ge=1, le=20)
    axis: Literal["log_amplitude", "amplitude"] = "log_amplitude"
    needs: ClassVar[tuple[str, ...]] = ("amplitude",)


class TensorSpline(SplineTerm):
    r"""Surface over measured distance and amplitude, made of products of cubic B-splines.

    .. math:: S(u, w) = \sum_{(j, k) \ne m} t_{jk} B_j(u) B_k(w)

    Lindner and Kolb (2007), "Calibration of the intensity-related distance error of the PMD
    ToF-camera". Much of the rectangle of distances and amplitudes holds no pixel (far targets are
    dark): there the penalty continues the surface along straight lines.

    Args:
        options: Numbers of pieces, the amplitude's axis, strength of the penalty.
        domain: The ranges of distance and amplitude give the knots.

    Raises:
        CalibrationDataError: The domain knows no amplitudes.

    Shape:
        - Input: `(*)`, radial distances in metres, and `(*)`, amplitudes in the camera's units.
        - Output: `(*)`, predicted errors in metres.
    """

    centre: Tensor
    half_width: Tensor
    amplitude_centre: Tensor
    amplitude_half_width: Tensor
    floor: Tensor

    def __init__(self, options: TensorSplineOptions, domain: Domain) -> None:
        pieces = options.distance_segments, options.amplitude_segments
        stem = f"t{pieces[0]}x{pieces[1]}{'' if options.axis == 'log_amplitude' else 'lin'}"
        columns = range(pieces[1] + 3)
        names = [f"{stem}.{j}.{k}" for j in range(pieces[0] + 3) for k in columns]
        del names[len(names) // 2]
        super().__init__(options, "distance_amplitude", names)
        self.variable: str = options.axis
        self.distance_segments: int = pieces[0]
        self.amplitude_segments: int = pieces[1]
        for prefix, variable in (("", "distance"), ("amplitude_", options.axis)):
            self.register_interval(prefix, domain.interval(variable))  # type: ignore[arg-type]
        self.register_number("floor", domain.amplitude_floor())

    def nonzero(self, radial_distance: Tensor, amplitude: Tensor) -> Nonzero:
        """Return the products that are not zero."""
        value = variable_of(self.variable, radial_distance, amplitude, self.floor)
        u = (radial_distance - self.centre) / self.half_width
        w = (value - self.amplitude_centre) / self.amplitude_half_width
        row, along = spline_weights(u, self.distance_segments, 3)
        column, across = spline_weights(w, self.amplitude_segments, 3)
        columns, size = self.amplitude_segments + 3, len(across)
        start = row * columns + column
        # TorchScript knows no comprehension over two ranges.
        positions = [start + (columns * (i // size) + i % size) for i in range(size * size)]
        return positions, [along[i // size] * across[i % size] for i in range(size * size)]

    def axes(self) -> tuple[Axis, ...]:
        """Return the distance and the amplitude or its logarithm, with the knots."""
        amplitude = self.amplitude_centre, self.amplitude_half_width
        return (
            axis_of("distance", self.centre, self.half_width, self.distance_segments),
            axis_of(self.variable, *amplitude, self.amplitude_segments),
        )

    def roughness(self) -> Tensor:
        """Return second differences along both axes, shape (R, K)."""
        pieces = self.distance_segments, self.amplitude_segments
        along, across = (second_differences(number + 3, number) for number in pieces)
        rows, columns = (torch.eye(n + 3).double() / math.sqrt(n + 3) for n in pieces)
        both = torch.cat([torch.kron(along, columns), torch.kron(rows, across)])
        return without_middle(both.T).T
