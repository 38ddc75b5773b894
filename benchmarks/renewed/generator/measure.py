"""From a view to depth and amplitude: four samples a frequency, noise, demodulation, unwrapping."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from benchmarks.renewed.generator.conditions import NOMINAL_US
from benchmarks.renewed.generator.form import Hook
from benchmarks.renewed.generator.sensor import CONTRAST, READ_NOISE, Sensor
from benchmarks.renewed.generator.view import View, changed, see
from benchmarks.renewed.generator.world import World
from benchmarks.withheld.generator.camera import SPEED_OF_LIGHT
from benchmarks.withheld.generator.rigid import Array

KERNELS = {
    "mean of 3x3": np.ones(3) / 3,
    "gauss of 1.2 pixels": np.exp(-0.5 * (np.arange(-3, 4) / 1.2) ** 2),
}
LAMP = 0.15  # electrons of the logged background light at 1, over a bright pixel's


@dataclass(frozen=True)
class Measured:
    """What the camera gives; arrays (N, H, W)."""

    view: View
    depth: Array  # radial, metres
    amplitude: Array  # electrons


def measure(
    world: World, hooks: Sequence[Hook] = (), rng: np.random.Generator | None = None
) -> Measured:
    """Measure a world with effects; without a generator of noise there is none."""
    view = see(world, hooks)
    depth, square = np.zeros_like(view.path), np.zeros_like(view.path)
    for frequency, weight in zip(world.sensor.frequencies, world.sensor.weights, strict=True):
        taps = samples(replace(view, frequency=frequency), hooks)
        if rng is not None:
            taps = taps + _noise(rng, taps, world)
        phase, amplitude = demodulate(taps)
        full = SPEED_OF_LIGHT / (2 * frequency)
        single = phase / (2 * np.pi) * full
        depth += weight * (single + full * np.round((view.path - single) / full))
        square += weight * amplitude**2
    return Measured(view, depth, np.sqrt(square))


def noise_of(world: World, hooks: Sequence[Hook] = ()) -> Array:
    """Standard deviation of the depth's noise and rounding (N, H, W), metres, to first order."""
    view, sensor = see(world, hooks), world.sensor
    square = np.full_like(view.path, sensor.rounding**2 / 12)
    kernel = KERNELS.get(sensor.spatial_filter, np.ones(1))
    kept = float((kernel**2).sum() / kernel.sum() ** 2) ** 2
    for frequency, weight in zip(sensor.frequencies, sensor.weights, strict=True):
        taps = samples(replace(view, frequency=frequency), hooks)
        noise = kept * _smooth(np.maximum(taps, 0) + READ_NOISE**2, kernel**2)
        real, imaginary = (taps[0] - taps[2]) / 2, (taps[3] - taps[1]) / 2
        turn = real**2 * (noise[3] + noise[1]) + imaginary**2 * (noise[0] + noise[2])
        radians = np.sqrt(turn / 4) / np.maximum(real**2 + imaginary**2, 1e-9)
        square += (weight * SPEED_OF_LIGHT / (4 * np.pi * frequency) * radians) ** 2
    return np.sqrt(square)


def samples(view: View, hooks: Sequence[Hook] = ()) -> Array:
    """The four correlation samples (4, N, H, W) at the view's frequency, electrons."""
    turn = 4 * np.pi * view.frequency / SPEED_OF_LIGHT
    phasor = changed("light", hooks, view, view.amplitude * np.exp(1j * turn * view.path))
    mean = np.abs(phasor) / CONTRAST + background(view)
    real, imaginary = np.real(phasor), np.imag(phasor)
    taps = np.stack([mean + real, mean - imaginary, mean - real, mean + imaginary])
    return changed("taps", hooks, view, taps)


def background(view: View) -> Array:
    """Electrons (N, H, W) of light that is not modulated: lamps that are logged, and the sun."""
    conditions = view.world.conditions
    lamp = LAMP * view.bright * conditions.ambient[:, None, None]
    exposure = (conditions.exposure / NOMINAL_US)[:, None, None]
    return (lamp + view.world.sensor.sun) * exposure * view.reflectivity


def demodulate(taps: Array) -> tuple[Array, Array]:
    """Phase (N, H, W) and amplitude of four samples."""
    real, imaginary = (taps[0] - taps[2]) / 2, (taps[3] - taps[1]) / 2
    return np.arctan2(imaginary, real), np.hypot(real, imaginary)


def _noise(rng: np.random.Generator, taps: Array, world: World) -> Array:
    """Shot and read noise as the camera's filters leave it: they act on nothing else here.

    A filter that also blurs the picture would be an effect; this one leaves neighbours and
    successive frames of a pose with noise in common.
    """
    sensor = world.sensor
    white = _standard(rng, taps.shape, sensor.tail) * np.sqrt(np.maximum(taps, 0) + READ_NOISE**2)
    if sensor.spatial_filter != "none":
        white = _smooth(white, KERNELS[sensor.spatial_filter])
    return _remembered(white, sensor, world.way.pose_id)


def _remembered(noise: Array, sensor: Sensor, pose_id: np.ndarray) -> Array:
    """Noise of which each frame keeps a share of the one before, within a pose."""
    keep = sensor.temporal_filter
    for i in range(1, noise.shape[1] if keep else 0):
        if pose_id[i] == pose_id[i - 1]:
            noise[:, i] = keep * noise[:, i - 1] + np.sqrt(1 - keep**2) * noise[:, i]
    return noise


def _smooth(values: Array, kernel: Array) -> Array:
    """Convolve the last two axes; the border is mirrored."""
    kernel, half = kernel / kernel.sum(), len(kernel) // 2
    for axis in (-1, -2):
        width = [(0, 0)] * values.ndim
        width[axis] = (half, half)
        padded = np.pad(values, width, mode="reflect")
        n = values.shape[axis]
        shifted = [np.take(padded, np.arange(i, i + n), axis=axis) for i in range(len(kernel))]
        values = np.tensordot(kernel, np.stack(shifted), axes=1)
    return values


def _standard(rng: np.random.Generator, shape: tuple[int, ...], tail: float) -> Array:
    if np.isinf(tail):
        return rng.standard_normal(shape)
    return rng.standard_t(tail, shape) * np.sqrt((tail - 2) / tail)
