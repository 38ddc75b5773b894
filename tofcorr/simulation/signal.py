"""The camera's signal: light, delays, correlation samples, demodulation and readout.

A delay is given as the distance error that it causes, in metres; positive reads too far.

Light source and pixel are switched on and off, so their correlation has harmonics. Four samples a
quarter period apart cannot separate the odd orders from the fundamental (they alias onto it). The
result is the circular error, with four periods in the unambiguous range. The even orders cancel in
the differences of opposite samples.
"""

import math
from collections.abc import Callable, Sequence
from itertools import pairwise
from typing import Annotated, Literal, Self

import numpy as np
import torch
from pydantic import Field, model_validator
from torch import Tensor

from tofcorr.conditions import condition
from tofcorr.geometry.rays import unambiguous_range
from tofcorr.options import Count, NonNegativeNumber, Number, Options, PositiveNumber
from tofcorr.simulation.hooks import FrameState


class Curve:
    """A cubic spline through knots, constant beyond the first and the last one.

    With four knots or more (not-a-knot end conditions) it reproduces any cubic polynomial.

    Args:
        knots: Increasing, at least two.
        values: One per knot.
    """

    def __init__(self, knots: tuple[float, ...], values: tuple[float, ...]) -> None:
        from scipy.interpolate import CubicSpline, PPoly  # Slow to import; few commands need it.

        spline: PPoly = CubicSpline(knots, values)
        self._breaks = torch.from_numpy(spline.x.copy())
        self._coefficients = torch.from_numpy(spline.c.copy())

    def __call__(self, position: Tensor) -> Tensor:
        """Return the curve at `position`, any shape."""
        inside = position.clamp(self._breaks[0], self._breaks[-1])
        piece = torch.searchsorted(self._breaks[1:-1], inside.detach().contiguous(), right=True)
        powers = (inside - self._breaks[piece])[..., None] ** torch.arange(3, -1, -1)
        return (self._coefficients.T[piece] * powers).sum(-1)


def image_from_lattice(values: tuple[tuple[float, ...], ...], height: int, width: int) -> Tensor:
    """Return the image (height, width) that interpolates a coarse lattice.

    The lattice spans the image evenly, from the centre of the first pixel to that of the last.
    Cubic splines along rows and columns interpolate between its points.
    """
    from scipy.interpolate import CubicSpline  # Slow to import; few commands need it.

    image = np.array(values)
    for axis, count in enumerate((height, width)):
        image = np.repeat(image, 2, axis) if image.shape[axis] == 1 else image
        knots = np.linspace(0.0, 1.0, image.shape[axis])
        image = CubicSpline(knots, image, axis)(np.linspace(0.0, 1.0, count))
    return torch.from_numpy(image)


# The light that returns: inverse square law, incidence, vignetting, integration time.


class LightOptions(Options):
    """Light source, lens and sensitivity of the pixel.

    Attributes:
        electrons_at_1m: Mean number of electrons in one tap at 1 m from a frontal wall of
            reflectivity 1, on the optical axis, in the reference integration time.
        reference_integration_time_us: Integration time of `electrons_at_1m`.
        demodulation_contrast: Amplitude over the mean of the taps, without ambient light.
        vignetting_exponent: n of cos^n of the angle to the optical axis; a simple lens has 4.
    """

    electrons_at_1m: PositiveNumber = 300_000.0
    reference_integration_time_us: PositiveNumber = 500.0
    demodulation_contrast: Annotated[float, Field(gt=0, le=1)] = 0.5
    vignetting_exponent: NonNegativeNumber = 4.0


def amplitude_per_reflectivity(options: LightOptions, state: FrameState) -> Tensor:
    """Return the amplitude in electrons for a wall of reflectivity 1, shape (H, W).

    A source beside the camera lights a Lambertian wall in proportion to cos(incidence) /
    distance^2. The way back adds no factor: a pixel sees a larger patch in proportion to
    distance^2, which cancels the fall-off of the light from each point. An unknown integration time
    is taken as the reference.
    """
    vignetting = state.ray_directions[..., 2] ** options.vignetting_exponent
    reference = options.reference_integration_time_us * condition("integration_time").si_per_unit
    exposure = (state.recorded("integration_time") or reference) / reference
    electrons = options.electrons_at_1m * exposure * options.demodulation_contrast
    return electrons * vignetting * state.incidence_cosine / state.radial_distance**2


# Delays of a pixel's signal: by its place on the chip, its charge, and the clock.


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
        return self.scale_mm / 1000 * curve


class CurveTable(Options):
    """A cubic spline through knots, constant beyond them; its values are metres."""

    knots: Annotated[tuple[Number, ...], Field(min_length=2)]
    values_m: tuple[Number, ...]

    @model_validator(mode="after")
    def _matched(self) -> Self:
        if len(self.knots) != len(self.values_m):
            raise ValueError(f"{len(self.knots)} knots but {len(self.values_m)} values_m")
        if any(later <= earlier for earlier, later in pairwise(self.knots)):
            raise ValueError("the knots must increase")
        return self


class AmplitudeTable(CurveTable):
    """A curve over amplitude in counts, or over amplitude times squared distance (counts m^2)."""

    variable: Literal["amplitude", "normalised_amplitude"] = "amplitude"


_Row = Annotated[tuple[Number, ...], Field(min_length=1)]


class LatticeTable(Options):
    """A bicubic map through a regular lattice of points from corner to corner of the image."""

    values_m: Annotated[tuple[_Row, ...], Field(min_length=1)]

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


def delays(
    options: DelayOptions, ray_directions: Tensor, electrons_per_count: float
) -> Callable[[Tensor, Tensor], Tensor]:
    """Return the delay of every pixel of one camera, as a function of distance and amplitude.

    Args:
        options: The size of the delays.
        ray_directions: Unit viewing rays of every pixel, shape (H, W, 3).
        electrons_per_count: Electrons for one count of amplitude.

    Returns:
        A function of true distances, (H, W), metres, and amplitudes, (H, W), electrons; it returns
        metres, (H, W).
    """
    measured = options.measured
    by_pixel = pixel_delay(options.pixel, ray_directions)
    by_pixel = by_pixel + options.constant_mm / 1000 + measured.constant_m
    if measured.pixel is not None:
        by_pixel = by_pixel + image_from_lattice(measured.pixel.values_m, *by_pixel.shape)
    by_distance, by_amplitude = map(_curve_of, (measured.distance, measured.amplitude))
    squared = measured.amplitude is not None and measured.amplitude.variable != "amplitude"

    def of(radial_distance: Tensor, amplitude: Tensor) -> Tensor:
        delay = by_pixel + options.clock_deviation * radial_distance
        if options.amplitude.scale_mm:
            delay = delay + options.amplitude.delay(amplitude)
        counts = amplitude / electrons_per_count * (radial_distance**2 if squared else 1.0)
        return delay + by_distance(radial_distance) + by_amplitude(counts)

    return of


def _curve_of(table: CurveTable | None) -> Callable[[Tensor], Tensor]:
    return torch.zeros_like if table is None else Curve(table.knots, table.values_m)


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
    return (slopes + lines + bowl + options.irregular_mm * irregular) / 1000


# The correlation function of a modulated signal that is not quite sinusoidal.


class Harmonic(Options):
    """One overtone of the correlation function.

    Attributes:
        order: Multiple of the modulation frequency, 2 to 1000.
        share: Its amplitude, relative to that of the fundamental.
        phase_deg: Its phase at distance zero.
    """

    # No light source of a camera follows an overtone beyond the twentieth; an integer without limit
    # fits into no float.
    order: Annotated[int, Field(ge=2, le=1000)]
    share: Number
    phase_deg: Number = 0.0


def harmonic_tensors(harmonics: Sequence[Harmonic]) -> tuple[Tensor, Tensor]:
    """Return orders (M,) float64 and relative phasors (M,) complex128, the fundamental first."""
    overtones = [(each.order, each.share, math.radians(each.phase_deg)) for each in harmonics]
    rows = torch.tensor([(1.0, 1.0, 0.0), *overtones], dtype=torch.float64)
    order, share, phase = rows.unbind(1)
    return order, share * torch.exp(1j * phase)


def correlation_samples(
    orders: Tensor, signal: Tensor, background: Tensor, tap_phasor: Tensor | None = None
) -> Tensor:
    """Sample the correlation function at quarters of the period.

    Args:
        orders: Shape (M,).
        signal: Phasors, shape (M, H, W), complex128.
        background: Shape (H, W).
        tap_phasor: Factor on each harmonic at each tap, shape (4, M, H, W); None: 1.

    Returns:
        A_k = background + Re sum_m signal_m exp(1j m k pi / 2), shape (4, H, W).
    """
    quarters = torch.arange(4, dtype=torch.float64)[:, None] * (math.pi / 2)
    shift = torch.exp(1j * quarters * orders)
    turned = signal if tap_phasor is None else tap_phasor * signal
    return background + (shift[..., None, None] * turned).sum(1).real


# From four samples to phase, amplitude, offset and distance: equations 1 to 3 of Abdo and Borgeat
# (2010).


def demodulate(samples: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Demodulate correlation samples A_k = offset + amplitude cos(phase + k pi / 2).

    phase = atan2(A3 - A1, A0 - A2), amplitude = sqrt((A3 - A1)^2 + (A0 - A2)^2) / 2,
    offset = (A0 + A1 + A2 + A3) / 4.

    Args:
        samples: A0..A3, shape (..., 4, H, W).

    Returns:
        Phase in [0, 2 pi), radians; amplitude and offset in the unit of the samples; (..., H, W).
    """
    first, second, third, fourth = samples.unbind(-3)
    sine, cosine = fourth - second, first - third
    phase = torch.remainder(torch.atan2(sine, cosine), 2 * math.pi)
    return phase, torch.hypot(sine, cosine) / 2, samples.mean(-3)


def distance_from_phase(phase: Tensor, modulation_frequency: float) -> Tensor:
    """Return c phase / (4 pi f): radial distance in metres within the unambiguous range."""
    return phase * (unambiguous_range(modulation_frequency) / (2 * math.pi))


# From expected electrons to counts: shot noise, read noise, full well and converter.


class ReadoutOptions(Options):
    """Noise and converter.

    Attributes:
        read_noise_electrons: Standard deviation in each sample.
        electrons_per_count: Electrons per count of the converter. Amplitude, ambient light and raw
            samples of the recording are in counts.
        converter_bits: Resolution. A pixel with a sample at the largest count has no distance.
        least_amplitude_counts: Pixels with a smaller amplitude have no distance.
    """

    read_noise_electrons: NonNegativeNumber = 200.0
    electrons_per_count: PositiveNumber = 40.0
    converter_bits: Annotated[int, Field(ge=4, le=32)] = 16
    least_amplitude_counts: NonNegativeNumber = 0.0

    def largest_count(self) -> float:
        """Return the count at which a sample is saturated."""
        return 2.0**self.converter_bits - 1


def read_out(taps: Tensor, options: ReadoutOptions, generator: torch.Generator | None) -> Tensor:
    """Return the samples in counts.

    Photo-electrons are Poisson distributed, read noise is normal, the converter rounds and clips.

    Args:
        taps: Expected electrons, shape (4, H, W).
        options: Noise and converter.
        generator: Source of randomness; None: expected counts, neither rounded nor limited.

    Returns:
        Counts, shape (4, H, W).
    """
    if generator is None:
        return taps / options.electrons_per_count
    electrons = torch.poisson(taps.nan_to_num(0.0).clamp_min(0.0), generator)
    read_noise = torch.randn(taps.shape, generator=generator, dtype=taps.dtype)
    electrons = electrons + options.read_noise_electrons * read_noise
    counts = torch.round(electrons / options.electrons_per_count)
    return counts.clamp(0.0, options.largest_count())
