"""Curves and a surface through knots: B-splines of the distance, the amplitude, or both."""

import math
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
)


def position(scaled: Tensor, segments: int) -> Tensor:
    """Map [-1, 1] onto the knots 0, 1, .., segments, clamped to the ends."""
    return (scaled.clamp(-1.0, 1.0) + 1.0) * (0.5 * segments)


def spline_basis(scaled: Tensor, segments: int, degree: int) -> Tensor:
    """Return all B-splines, shape (segments + degree, ...), of a variable scaled to [-1, 1]."""
    x = position(scaled, segments)
    functions = []
    for k in range(segments + degree):
        if degree == 1:
            functions.append((1.0 - (x - k).abs()).clamp(min=0.0))
        else:
            t = (x - (k - 1)).abs()
            outer, inner = (2.0 - t).clamp(min=0.0), (1.0 - t).clamp(min=0.0)
            functions.append((outer * outer * outer - 4.0 * inner * inner * inner) / 6)
    return torch.stack(functions)


def spline_weights(x: Tensor, segments: int, degree: int) -> tuple[Tensor, list[Tensor]]:
    """Return the first of the degree + 1 splines that are not zero, and their values.

    Args:
        x: As `position` gives it, shape (...); NaN gives values of NaN.
        segments: Number of segments.
        degree: 1 or 3.
    """
    first = x.nan_to_num(0.0).floor().clamp(0.0, float(segments - 1)).to(torch.int64)
    f = x - first
    g = 1.0 - f
    if degree == 1:
        return first, [g, f]
    square, other = f * f, g * g
    inner = 3.0 * (f - 2.0) * square + 4.0
    mirrored = 3.0 * (g - 2.0) * other + 4.0
    return first, [value / 6 for value in [g * other, inner, mirrored, f * square]]


def spline_value(full: Tensor, scaled: Tensor, segments: int, degree: int) -> Tensor:
    """Return sum_k full[k] B_k, shape of `scaled`, from the splines that are not zero."""
    first, weights = spline_weights(position(scaled, segments), segments, degree)
    value = weights[0] * full[first]
    for k in range(1, degree + 1):
        value = value + weights[k] * full[first + k]
    return value


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


_Strength = Literal["auto"] | NonNegativeFloat


class SplineOptions(BaseTermOptions):
    """What the options of all splines share: a strength that may be found in the data."""

    found_in_data: ClassVar[tuple[str, ...]] = ("strength",)


class DistanceSplineOptions(SplineOptions):
    """Options of a `SignalSpline` over the distance with cubic pieces.

    Attributes:
        segments: Pieces over the calibrated range of distances.
        strength: Weight of the integrated squared curvature against the mean squared residual.
    """

    kind: Literal["distance_spline"] = "distance_spline"
    segments: int = Field(default=24, ge=2, le=100)
    strength: _Strength = "auto"
    variable: ClassVar[Variable] = "distance"
    degree: ClassVar[int] = 3
    letter: ClassVar[str] = "s"


class LookupTableOptions(SplineOptions):
    """Options of a `SignalSpline` with linear pieces: a table with interpolation.

    Attributes:
        segments: Intervals between the table's entries, over the calibrated range of distances.
        strength: Weight of the integrated squared curvature against the mean squared residual.
    """

    kind: Literal["lookup_table"] = "lookup_table"
    segments: int = Field(default=48, ge=2, le=200)
    strength: _Strength = "auto"
    variable: ClassVar[Variable] = "distance"
    degree: ClassVar[int] = 1
    letter: ClassVar[str] = "l"


class IncidentLightOptions(SplineOptions):
    """Options of a `SignalSpline` over the logarithm of the amplitude.

    Attributes:
        segments: Pieces over the calibrated range of log amplitude.
        strength: Weight of the integrated squared curvature against the mean squared residual.
    """

    kind: Literal["incident_light"] = "incident_light"
    segments: int = Field(default=6, ge=2, le=100)
    strength: _Strength = "auto"
    needs: ClassVar[tuple[str, ...]] = ("amplitude",)
    variable: ClassVar[Variable] = "log_amplitude"
    degree: ClassVar[int] = 3
    letter: ClassVar[str] = "a"


class SignalSpline(CurveTerm):
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

    def basis(self, radial_distance: Tensor, amplitude: Tensor) -> Tensor:
        """Return the B-splines but the middle one, shape (K, ...)."""
        scaled = self.scaled(radial_distance, amplitude)
        return without_middle(spline_basis(scaled, self.segments, self.degree))

    def forward(self, radial_distance: Tensor, amplitude: Tensor) -> Tensor:
        """Return the predicted error, shape (...), metres."""
        scaled = self.scaled(radial_distance, amplitude)
        return spline_value(with_middle(self.coefficients), scaled, self.segments, self.degree)

    def axes(self) -> tuple[Axis, ...]:
        """Return the variable, with the knots."""
        return (self.axis(self.segments),)

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
        strength: Weight of the integrated squared curvature, along both axes, against the mean
            squared residual.
    """

    kind: Literal["tensor_spline"] = "tensor_spline"
    distance_segments: int = Field(default=5, ge=1, le=40)
    amplitude_segments: int = Field(default=3, ge=1, le=20)
    axis: Literal["log_amplitude", "amplitude"] = "log_amplitude"
    strength: _Strength = "auto"
    needs: ClassVar[tuple[str, ...]] = ("amplitude",)


class TensorSpline(SignalTerm):
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
        self_is_log = options.axis == "log_amplitude"
        pieces = (options.distance_segments, options.amplitude_segments)
        rows, columns = (segments + 3 for segments in pieces)
        stem = f"t{pieces[0]}x{pieces[1]}{'' if self_is_log else 'lin'}"
        names = [f"{stem}.{j}.{k}" for j in range(rows) for k in range(columns)]
        del names[len(names) // 2]
        super().__init__(options, "distance_amplitude", names)
        self.is_log: bool = self_is_log
        self.rows: int = rows
        self.columns: int = columns
        self.distance_segments: int = pieces[0]
        self.amplitude_segments: int = pieces[1]
        for prefix, interval in (
            ("", domain.radial_distance),
            ("amplitude_", domain.interval(options.axis)),
        ):
            self.register_number(f"{prefix}centre", interval.centre)
            self.register_number(f"{prefix}half_width", interval.half_width)
        self.register_number("floor", domain.amplitude_floor())

    def scaled_amplitude(self, amplitude: Tensor) -> Tensor:
        """Return the scaled amplitude or its logarithm w, shape (...)."""
        value = torch.maximum(amplitude, self.floor).log() if self.is_log else amplitude
        return (value - self.amplitude_centre) / self.amplitude_half_width

    def basis(self, radial_distance: Tensor, amplitude: Tensor) -> Tensor:
        """Return the products but the middle one, shape (K, ...)."""
        u = (radial_distance - self.centre) / self.half_width
        by_distance = spline_basis(u, self.distance_segments, 3)
        by_amplitude = spline_basis(self.scaled_amplitude(amplitude), self.amplitude_segments, 3)
        return without_middle((by_distance[:, None] * by_amplitude[None, :]).flatten(0, 1))

    def forward(self, radial_distance: Tensor, amplitude: Tensor) -> Tensor:
        """Return the predicted error, shape (...), metres."""
        full = with_middle(self.coefficients)
        x = position((radial_distance - self.centre) / self.half_width, self.distance_segments)
        y = position(self.scaled_amplitude(amplitude), self.amplitude_segments)
        row, along = spline_weights(x, self.distance_segments, 3)
        column, across = spline_weights(y, self.amplitude_segments, 3)
        first = row * self.columns + column
        total = torch.zeros_like(x)
        for j in range(4):
            start = first + j * self.columns
            inner = across[0] * full[start]
            for k in range(1, 4):
                inner = inner + across[k] * full[start + k]
            total = total + along[j] * inner
        return total

    def axes(self) -> tuple[Axis, ...]:
        """Return the distance and the amplitude or its logarithm, with the knots."""
        d, h = float(self.centre), float(self.half_width)
        a, w = float(self.amplitude_centre), float(self.amplitude_half_width)
        variable: Variable = "log_amplitude" if self.is_log else "amplitude"
        return (
            Axis("distance", d - h, d + h, self.distance_segments),
            Axis(variable, a - w, a + w, self.amplitude_segments),
        )

    def roughness(self) -> Tensor:
        """Return second differences along both axes, shape (R, K)."""
        along = second_differences(self.rows, self.distance_segments)
        across = second_differences(self.columns, self.amplitude_segments)
        eye_rows = torch.eye(self.rows, dtype=torch.float64) / math.sqrt(self.rows)
        eye_columns = torch.eye(self.columns, dtype=torch.float64) / math.sqrt(self.columns)
        both = torch.cat([torch.kron(along, eye_columns), torch.kron(eye_rows, across)])
        return without_middle(both.T).T
