"""Forms of what correlation and samples do: wiggling, saturation, errors that follow amplitude."""

import numpy as np

from benchmarks.renewed.geometry import SPEED_OF_LIGHT, Array, Random
from benchmarks.renewed.signal_chain import Change, View, adding, demodulate, form
from benchmarks.renewed.world import World

TAPS = np.arange(4)[:, None, None, None] * np.pi / 2


@form("wiggling", "taps", 0.03, textbook=True)
def odd_harmonics(rng: Random, world: World) -> Change:
    """The correlation has third and fifth harmonics, of any phase."""
    third, fifth, share = *rng.uniform(0, 2 * np.pi, 2), rng.uniform(0.1, 0.4)

    def change(strength: float, view: View, taps: Array) -> Array:
        phase, amplitude = demodulate(taps)
        harmonic = np.cos(3 * (phase + TAPS) + third) + share * np.cos(5 * (phase + TAPS) + fifth)
        return taps + strength * amplitude * harmonic

    return change


@form("wiggling", "taps", 0.5)
def duty_cycle(rng: Random, world: World) -> Change:
    """A rectangular source, on for another share than half, against rectangular gates."""
    duty, odd = rng.uniform(0.38, 0.62), np.array([3, 5, 7, 9])
    size = np.sin(np.pi * odd * duty) * np.sin(np.pi * odd / 2) / odd**2 / np.sin(np.pi * duty)

    def change(strength: float, view: View, taps: Array) -> Array:
        phase, amplitude = demodulate(taps)
        sharp = strength ** ((odd - 1) / 2)  # what the driver's bandwidth leaves of each harmonic
        for m, share in zip(odd, size * sharp, strict=True):
            taps = taps + amplitude * share * np.cos(m * (phase + TAPS))
        return taps

    return change


@form("wiggling", "path", 0.005)
def phase_table(rng: Random, world: World) -> Change:
    """A bench table of the phase: unlike gains of the taps, and the bench's own irregularities."""
    knots = np.arange(16) * 2 * np.pi / 16
    table = np.cos(2 * knots + rng.uniform(0, 6)) + 0.6 * rng.standard_normal(16)
    table -= table.mean()

    turn = 4 * np.pi * world.sensor.frequencies[-1] / SPEED_OF_LIGHT
    return adding(
        lambda view: np.interp(turn * view.distance % (2 * np.pi), knots, table, period=2 * np.pi)
    )


@form("saturation", "taps", 0.5, textbook=True, exposure="random")
def clipped(rng: Random, world: World) -> Change:
    """Samples stop at a full well."""
    return lambda strength, view, taps: np.minimum(taps, taps.max() / (1 + strength))


@form("saturation", "taps", 0.7, exposure="random")
def soft_knee(rng: Random, world: World) -> Change:
    """The well fills ever more slowly."""
    power = rng.uniform(2.0, 5.0)

    def change(strength: float, view: View, taps: Array) -> Array:
        full = taps.max() / max(strength, 1e-6)
        return taps / (1 + (taps / full) ** power) ** (1 / power)

    return change


@form("saturation", "taps", 0.5, exposure="random")
def blooming(rng: Random, world: World) -> Change:
    """Charge beyond a full well runs into the pixels above and below, into the same sample."""
    lost, length = rng.uniform(0.2, 0.5), rng.uniform(1.0, 4.0)

    def change(strength: float, view: View, taps: Array) -> Array:
        full = taps.max() / (1 + strength)
        over = np.maximum(taps - full, 0.0)
        rows = np.arange(taps.shape[2])
        spread = np.exp(-np.abs(rows[:, None] - rows) / length)
        np.fill_diagonal(spread, 0.0)
        spread *= (1 - lost) / spread.sum(1).max()
        run = np.einsum("rs,knsw->knrw", spread, over, optimize=True)
        return np.minimum(taps, full) + np.minimum(run, full)

    return change


@form("amplitude", "path", 0.005, textbook=True)
def dark_power_law(rng: Random, world: World) -> Change:
    """Dark pixels drift, by a power of the amplitude."""
    power, sign = rng.uniform(0.3, 0.8), rng.choice([-1.0, 1.0])
    return adding(lambda view: sign * (_shine(view) / 0.1) ** -power)


@form("amplitude", "path", 0.008)
def gain_switch(rng: Random, world: World) -> Change:
    """The converter switches its gain at an amplitude; the two ranges differ by an offset."""
    at, soft, sign = rng.uniform(0.08, 0.35), rng.uniform(0.02, 0.08), rng.choice([-1.0, 1.0])
    return adding(lambda view: sign / (1 + (_shine(view) / at) ** (1 / soft)))


@form("amplitude", "path", 0.005)
def amplitude_table(rng: Random, world: World) -> Change:
    """A bench table over the logarithm of the amplitude, up and down."""
    knots, table = np.linspace(-5.5, 0.5, 9), rng.standard_normal(9)
    return adding(lambda view: np.interp(np.log(_shine(view)), knots, table))


def _shine(view: View) -> Array:
    return np.clip(view.amplitude / view.bright, 2e-3, 3.0)
