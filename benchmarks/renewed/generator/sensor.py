"""The camera that is drawn: lens, modulation, light, noise, filters."""

from dataclasses import dataclass, replace

import numpy as np

from benchmarks.renewed.generator import ranges
from benchmarks.withheld.generator.camera import SPEED_OF_LIGHT, Camera
from benchmarks.withheld.generator.rigid import Array

CONTRAST = 0.55  # modulated share of the returned light
READ_NOISE = 30.0  # electrons


@dataclass(frozen=True)
class Sensor:
    """One camera; `lens.sensitivity` is in electrons of a white target at 1 m."""

    lens: Camera
    frequencies: tuple[float, ...]  # Hz, ascending
    sun: float  # electrons of sunlight on a white target at nominal exposure
    tail: float
    spatial_filter: str
    temporal_filter: float
    rounding: float  # metres
    depth_kind: str
    base: "BaseErrors"

    @property
    def weights(self) -> Array:
        """Weight of each frequency in the depth: the inverse of its variance."""
        square = np.array(self.frequencies) ** 2
        return square / square.sum()


@dataclass(frozen=True)
class BaseErrors:
    """A cubic in distance, squares of column and row, a square in amplitude: what a base has."""

    middle: float
    half: float
    of_distance: tuple[float, ...]  # metres, of 1, v, v^2, v^3 with v the distance in (-1, 1)
    of_pixel: tuple[float, ...]  # of column, row, column^2, row^2, each in (-1, 1)
    of_amplitude: tuple[float, ...]  # of u, u^2 with u the amplitude over a bright one
    bright: float = 1.0  # electrons

    def at(self, distance: Array, amplitude: Array) -> Array:
        """The error (N, H, W) in metres."""
        v = np.clip((distance - self.middle) / self.half, -2.3, 2.3)
        u = amplitude / self.bright
        height, width = distance.shape[1:]
        column, row = np.meshgrid(np.linspace(-1, 1, width), np.linspace(-1, 1, height))
        c0, c1, c2, c3 = self.of_distance
        a, b, aa, bb = self.of_pixel
        pixel = a * column + b * row + aa * column**2 + bb * row**2
        i1, i2 = self.of_amplitude
        return c0 + v * (c1 + v * (c2 + v * c3)) + pixel + u * (i1 + u * i2)


def draw_sensor(rng: np.random.Generator, near: float, far: float) -> Sensor:
    """Draw a camera that is exposed for distances from near to far."""
    frequencies = tuple(1e6 * f for f in ranges.draw_of(ranges.FREQUENCIES_MHZ, rng))
    middle = float(np.sqrt(near * far))
    electrons = _electrons(ranges.NOISE_MM.draw(rng) * 1e-3, frequencies)
    outdoor = rng.uniform() < ranges.OUTDOOR
    sun = ranges.SUN.draw(rng)
    lens = _lens(rng, frequencies[-1])
    return Sensor(
        lens=replace(lens, sensitivity=electrons * middle**2),
        frequencies=frequencies,
        sun=sun * electrons if outdoor else 0.0,
        tail=ranges.draw_of(ranges.TAILS, rng),
        spatial_filter=ranges.draw_of(ranges.SPATIAL_FILTER, rng),
        temporal_filter=ranges.draw_of(ranges.TEMPORAL_FILTER, rng),
        rounding=1e-3 * ranges.draw_of(ranges.ROUNDING_MM, rng),
        depth_kind=ranges.draw_of(ranges.DEPTH_KIND, rng),
        base=_base(rng, near, far),
    )


def _lens(rng: np.random.Generator, frequency: float) -> Camera:
    width, height = ranges.draw_of(ranges.IMAGES, rng)
    focal = width * ranges.FOCAL_WIDTHS.draw(rng)
    barrel = ranges.BARREL.draw(rng)
    off = rng.normal(0, 0.012 * width, 2)
    return Camera(
        width=width,
        height=height,
        focal=(focal, focal * rng.uniform(0.997, 1.003)),
        centre=((width - 1) / 2 + off[0], (height - 1) / 2 + off[1]),
        distortion=(barrel, -0.3 * barrel, *rng.normal(0, 4e-4, 2), 0.0),
        modulation_frequency=frequency,
        sensitivity=1.0,
        counts_per_electron=ranges.Range(0.005, 0.3, log=True).draw(rng),
    )


def _electrons(noise: float, frequencies: tuple[float, ...]) -> float:
    """Amplitude at which the depth of one frame has this noise, by bisection on its logarithm."""
    low, high = 1.0, 1e9
    for _ in range(60):
        amplitude = np.sqrt(low * high)
        tap = amplitude / CONTRAST + READ_NOISE**2
        scale = SPEED_OF_LIGHT / (4 * np.pi * np.linalg.norm(frequencies))
        low, high = (
            (amplitude, high) if scale * np.sqrt(tap / 2) / amplitude > noise else (low, amplitude)
        )
    return float(np.sqrt(low * high))


def _base(rng: np.random.Generator, near: float, far: float) -> BaseErrors:
    spread = 1e-3
    return BaseErrors(
        middle=(near + far) / 2,
        half=(far - near) / 2,
        of_distance=tuple(rng.normal(0, np.array([20, 12, 6, 4]) * spread)),
        of_pixel=tuple(rng.normal(0, np.array([3, 3, 6, 6]) * spread)),
        of_amplitude=tuple(rng.normal(0, np.array([8, 4]) * spread)),
    )
