"""The error as a surface over distance and amplitude."""

import math
from typing import ClassVar, Literal

import torch
from pydantic import Field, NonNegativeFloat
from torch import Tensor

from tofcorr.error_terms.axis import Axis
from tofcorr.error_terms.base import SignalTerm
from tofcorr.error_terms.domain import Domain
from tofcorr.error_terms.log_amplitude import (
    amplitude_floor,
    known_amplitude,
    log_amplitude,
    log_interval,
)
from tofcorr.error_terms.spline import (
    position,
    second_differences,
    spline_basis,
    spline_size,
    spline_weights,
    with_middle,
    without_middle,
)
from tofcorr.error_terms.term_options import BaseTermOptions


class TensorSplineOptions(BaseTermOptions):
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
    strength: Literal["auto"] | NonNegativeFloat = "auto"
    needs: ClassVar[tuple[str, ...]] = ("amplitude",)
    found_in_data: ClassVar[tuple[str, ...]] = ("strength",)


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
        rows = spline_size(options.distance_segments, 3)
        columns = spline_size(options.amplitude_segments, 3)
        names = [
            f"t{options.distance_segments}x{options.amplitude_segments}"
            f"{'' if options.axis == 'log_amplitude' else 'lin'}.{j}.{k}"
            for j in range(rows)
            for k in range(columns)
        ]
        del names[len(names) // 2]
        super().__init__(options, "distance_amplitude", names)
        self.is_log: bool = options.axis == "log_amplitude"
        amplitudes = log_interval(domain) if self.is_log else known_amplitude(domain)
        self.rows: int = rows
        self.columns: int = columns
        self.distance_segments: int = options.distance_segments
        self.amplitude_segments: int = options.amplitude_segments
        self.register_number("centre", domain.radial_distance.centre)
        self.register_number("half_width", domain.radial_distance.half_width)
        self.register_number("amplitude_centre", amplitudes.centre)
        self.register_number("amplitude_half_width", amplitudes.half_width)
        self.register_number("floor", amplitude_floor(domain))

    def scaled_amplitude(self, amplitude: Tensor) -> Tensor:
        """Return the scaled amplitude or its logarithm w, shape (...)."""
        value = log_amplitude(amplitude, self.floor) if self.is_log else amplitude
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
        distance = (float(self.centre), float(self.half_width), self.distance_segments)
        amplitude = (
            *(float(self.amplitude_centre), float(self.amplitude_half_width)),
            self.amplitude_segments,
        )
        variable = "log_amplitude" if self.is_log else "amplitude"
        return Axis.around("distance", *distance), Axis.around(variable, *amplitude)

    def roughness(self) -> Tensor:
        """Return second differences along both axes, shape (R, K)."""
        along = second_differences(self.rows, self.distance_segments)
        across = second_differences(self.columns, self.amplitude_segments)
        eye_rows = torch.eye(self.rows, dtype=torch.float64) / math.sqrt(self.rows)
        eye_columns = torch.eye(self.columns, dtype=torch.float64) / math.sqrt(self.columns)
        both = torch.cat([torch.kron(along, eye_columns), torch.kron(eye_rows, across)])
        return without_middle(both.T).T
