"""Delays of a pixel's signal: by its place on the chip, its charge, and the clock.

A delay is given as the distance error that it causes, in metres; positive reads too far.
"""

import math
from typing import Annotated, Literal, Self

import torch
from pydantic import Field, model_validator
from torch import Tensor

from tofcorr.options import Options
from tofcorr.simulation.numbers import Count, NonNegativeNumber, Number, PositiveNumber
from tofcorr.simulation.splines import Curve, image_from_lattice

_Knots = Annotated[tuple[Number, ...], Field(min_length=2)]


class PixelDelayOptions(Options):
    """Delays that depend on the place of the pixel.

    Attributes:
        row_slope_mm: Delay of the last row relative to the first, linear in between: a signal that
            travels along the column.
        column_slope_mm: The same from the first column to the last.
        row_line_mm: Delay at the far end of the line that drives the rows from the top. Along a
            resistive and capacitive line it grows as x (2 - x), x from 0 to 1.
        column_line_mm: The same for the columns, driven from the left.
        bowl_mm: Delay at a viewing angle a of 45 deg; it grows as 1 / cos(a) - 1.
        irregular_mm: Standard deviation of a random delay of each pixel.
        unit: Seed of the random per-pixel delay: another number is another camera of the same type.
    """

    row_slope_mm: Number = 0.0
    column_slope_mm: Number = 0.0
    row_line_mm: Number = 0.0
    column_line_mm: Number = 0.0
    bowl_mm: Number = 0.0
    irregular_mm: NonNegativeNumber = 0.0
    unit: Count = 1


class AmplitudeDelayOptions(Options):
    """Delay that depends on the charge collected.

    With A the amplitude in electrons: scale ln(1 + A / electrons) (`log`), or
    scale (A / electrons)^exponent (`power`).
    """

    law: Literal["log", "power"] = "log"
    scale_mm: Number = 0.0
    electrons: PositiveNumber = 50_000.0
    exponent: Number = 0.5

    def delay(self, amplitude: Tensor) -> Tensor:
        """Return metres, of the shape of `amplitude` (electrons)."""
        share = amplitude / self.electrons
        curve = torch.log1p(share) if self.law == "log" else share**self.exponent
        return self.scale_mm * 1e-3 * curve


class CurveTable(Options):
    """A cubic spline through knots, constant beyond them; its values are metres."""

    knots: _Knots
    values_m: _Knots

    @model_validator(mode="after")
    def _matched(self) -> Self:
        if len(self.knots) != len(self.values_m):
            raise ValueError(f"{len(self.knots)} knots but {len(self.values_m)} values_m")
        if any(
            later <= earlier for earlier, later in zip(self.knots, self.knots[1:], strict=False)
        ):
            raise ValueError("the knots must increase")
        return self

    def curve(self) -> Curve:
        """Return the curve."""
        return Curve(self.knots, self.values_m)


class AmplitudeTable(CurveTable):
    """A curve over amplitude in counts, or over amplitude times squared distance (counts m^2)."""

    variable: Literal["amplitude", "normalised_amplitude"] = "amplitude"


class LatticeTable(Options):
    """A bicubic map through a regular lattice of points from corner to corner of the image."""

    values_m: Annotated[
        tuple[Annotated[tuple[Number, ...], Field(min_length=1)], ...], Field(min_length=1)
    ]

    @model_validator(mode="after")
    def _rectangular(self) -> Self:
        if len({len(row) for row in self.values_m}) > 1:
            raise ValueError("all rows must have the same length")
        return self


class MeasuredErrorOptions(Options):
    """Errors measured on a real camera, as tables; a fitted simulator reproduces them.

    Each is a mean of measured minus true distance and acts as a delay.

    Attributes:
        constant_m: The same for every pixel.
        distance: Over the true radial distance in metres.
        pixel: Over the image.
        amplitude: Over the amplitude that the camera reports.
    """

    constant_m: Number = 0.0
    distance: CurveTable | None = None
    pixel: LatticeTable | None = None
    amplitude: AmplitudeTable | None = None


class DelayOptions(Options):
    """All delays of the sensor.

    Attributes:
        constant_mm: The same for every pixel.
        clock_deviation: True over nominal modulation frequency, minus 1: measured distances are
            longer by this share.
        pixel: Delays by place on the chip.
        amplitude: Delay by charge.
        measured: Further delays, as tables.
    """

    constant_mm: Number = 0.0
    clock_deviation: Number = 0.0
    pixel: PixelDelayOptions = PixelDelayOptions()
    amplitude: AmplitudeDelayOptions = AmplitudeDelayOptions()
    measured: MeasuredErrorOptions = MeasuredErrorOptions()


class Delays:
    """The delays of one camera.

    Args:
        options: The size of the delays.
        ray_directions: Unit viewing rays of every pixel, shape (H, W, 3).
        electrons_per_count: Electrons for one count of amplitude.
    """

    def __init__(
        self, options: DelayOptions, ray_directions: Tensor, electrons_per_count: float
    ) -> None:
        self._options = options
        self._electrons_per_count = electrons_per_count
        measured = options.measured
        self._by_pixel = pixel_delay(options.pixel, ray_directions)
        self._by_pixel = self._by_pixel + options.constant_mm * 1e-3 + measured.constant_m
        if measured.pixel is not None:
            height, width = self._by_pixel.shape
            self._by_pixel = self._by_pixel + image_from_lattice(
                measured.pixel.values_m, height, width
            )
        self._distance_curve = measured.distance.curve() if measured.distance else None
        self._amplitude_curve = measured.amplitude.curve() if measured.amplitude else None

    def of(self, radial_distance: Tensor, amplitude: Tensor) -> Tensor:
        """Return the delay of every pixel.

        Args:
            radial_distance: True distances, shape (H, W), metres.
            amplitude: Electrons, shape (H, W).

        Returns:
            Shape (H, W), metres.
        """
        options = self._options
        delay = self._by_pixel + options.clock_deviation * radial_distance
        if options.amplitude.scale_mm:
            delay = delay + options.amplitude.delay(amplitude)
        if self._distance_curve is not None:
            delay = delay + self._distance_curve(radial_distance)
        if self._amplitude_curve is not None and options.measured.amplitude is not None:
            counts = amplitude / self._electrons_per_count
            if options.measured.amplitude.variable == "normalised_amplitude":
                counts = counts * radial_distance**2
            delay = delay + self._amplitude_curve(counts)
        return delay


def pixel_delay(options: PixelDelayOptions, ray_directions: Tensor) -> Tensor:
    """Return the delay by place on the chip, shape (H, W), metres."""
    height, width = ray_directions.shape[:2]
    down = torch.linspace(0.0, 1.0, height, dtype=torch.float64)[:, None]
    right = torch.linspace(0.0, 1.0, width, dtype=torch.float64)
    slopes = options.row_slope_mm * down + options.column_slope_mm * right
    lines = options.row_line_mm * down * (2 - down) + options.column_line_mm * right * (2 - right)
    bowl = options.bowl_mm * (1 / ray_directions[..., 2] - 1) / (math.sqrt(2.0) - 1)
    camera = torch.Generator().manual_seed(options.unit)
    irregular = torch.randn(height, width, generator=camera, dtype=torch.float64)
    return (slopes + lines + bowl + options.irregular_mm * irregular) * 1e-3
