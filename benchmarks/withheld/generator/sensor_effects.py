"""Effects inside the pixel: the correlation's shape, full wells, taps taken one by one."""

import numpy as np

from benchmarks.withheld.generator.effect import Applied, Effect
from benchmarks.withheld.generator.observe import View, trace
from benchmarks.withheld.generator.rigid import Array
from benchmarks.withheld.generator.world import World

TAPS = np.arange(4)
SAMPLES = 720


def wiggling(rng: np.random.Generator) -> Effect:
    """A square light pulse rounded by its driver, correlated with a gate of finite slopes."""
    rise, fall, duty = rng.uniform(0.25, 0.6), rng.uniform(0.25, 0.6), rng.uniform(0.46, 0.54)
    table = _correlation(rise, fall, duty)
    turns = np.linspace(0, 2 * np.pi, SAMPLES + 1)
    excess = np.append(table, table[0]) - np.cos(turns)

    def change(strength: float, view: View, taps: Array) -> Array:
        phase, size = np.angle(view.phasor), np.abs(view.phasor)
        more = [np.interp((phase + k * np.pi / 2) % (2 * np.pi), turns, excess) for k in TAPS]
        return taps + strength * size * np.stack(more)

    return Effect("wiggling", "taps", change, 1.0)


def saturation(rng: np.random.Generator) -> Effect:
    """Wells that are full take no more."""
    spread = rng.uniform(0.95, 1.05)

    def change(strength: float, view: View, taps: Array) -> Array:
        return np.minimum(taps, 14 * spread * view.world.camera.sensitivity / strength)

    return Effect("saturation", "taps", change, 1.0)


def motion(rng: np.random.Generator) -> Effect:
    """The tool moves on while samples are taken; the strength is the time between two, seconds."""
    del rng
    rates: dict[int, tuple[World, Array]] = {}

    def change(strength: float, view: View, taps: Array) -> Array:
        world = view.world
        if id(world) not in rates:
            rates[id(world)] = world, _distance_rate(world)
        moved = rates[id(world)][1] * strength * (TAPS[:, None, None, None] - 1.5)
        turn = np.exp(2j * np.pi / world.camera.unambiguous_range * moved) - 1
        quarter = np.exp(0.5j * np.pi * TAPS)[:, None, None, None]
        return taps + np.real(view.phasor * turn * quarter)

    return Effect("motion", "taps", change, 0.005)


def _distance_rate(world: World) -> Array:
    """Change of every pixel's distance (N, H, W) as the tool moves, m/s."""
    shifted = Effect("", "poses", lambda seconds, view, _: view.world.world_from_tool(seconds))
    step = 0.01
    ahead, behind = (
        trace(world, [Applied(shifted, sign * step)]).target_distance for sign in (1, -1)
    )
    return (ahead - behind) / (2 * step)


def _correlation(rise: float, fall: float, duty: float) -> Array:
    """Correlation of light and gate over one turn (SAMPLES,); its fundamental is a plain cosine."""
    turn = np.arange(SAMPLES) / SAMPLES
    on = 1 - np.exp(-turn / (rise / (2 * np.pi)))
    light = np.where(
        turn < duty,
        on,
        (1 - np.exp(-duty * 2 * np.pi / rise)) * np.exp(-(turn - duty) * 2 * np.pi / fall),
    )
    gate = np.tanh(np.sin(2 * np.pi * turn) / 0.15)
    spectrum = np.fft.rfft(light) * np.conj(np.fft.rfft(gate))
    spectrum[0] = 0.0
    spectrum /= 2 * np.abs(spectrum[1]) / SAMPLES
    shift = np.angle(spectrum[1])
    spectrum *= np.exp(-1j * shift * np.arange(len(spectrum)))
    return np.fft.irfft(spectrum, SAMPLES)
