"""Effects that lengthen or shorten the measured path: settings, heat, surface, electronics."""

import numpy as np

from benchmarks.withheld.generator.conditions import NOMINAL_EXPOSURE
from benchmarks.withheld.generator.effect import Effect
from benchmarks.withheld.generator.observe import View
from benchmarks.withheld.generator.rigid import Array


def integration_time(rng: np.random.Generator) -> Effect:
    """A bench table of offset against exposure: saturating, with the scatter of a bench."""
    knots = np.geomspace(200.0, 4500.0, 10)
    offsets = -np.exp(-knots / rng.uniform(600.0, 1400.0)) + rng.normal(0, 0.06, len(knots))
    offsets = (offsets - np.interp(NOMINAL_EXPOSURE, knots, offsets)) * rng.choice([-1.0, 1.0])

    def change(strength: float, view: View, path: Array) -> Array:
        return (
            path
            + strength * np.interp(view.world.conditions.exposure, knots, offsets)[:, None, None]
        )

    return Effect("integration_time", "path", change, 0.01)


def warm_up(rng: np.random.Generator) -> Effect:
    """Driver and sensor warm up with two time constants and cool down in gaps."""
    share, sign = rng.uniform(0.35, 0.65), rng.choice([-1.0, 1.0])

    def change(strength: float, view: View, path: Array) -> Array:
        heat = view.world.conditions
        cold = share * (1 - heat.fast_heat) + (1 - share) * (1 - heat.slow_heat)
        return path + sign * strength * cold[:, None, None]

    return Effect("warm_up", "path", change, 0.01)


def room_temperature(rng: np.random.Generator) -> Effect:
    """Delay of the electronics follows the room with a lag."""
    sign = rng.choice([-1.0, 1.0])

    def change(strength: float, view: View, path: Array) -> Array:
        return path + sign * strength * (view.world.conditions.lagged_room - 22.0)[:, None, None]

    return Effect("room_temperature", "path", change, 0.004)


def incidence_angle(rng: np.random.Generator) -> Effect:
    """Light enters a translucent layer, refracted, and travels on before it comes back."""
    index = rng.uniform(1.15, 1.5)

    def change(strength: float, view: View, path: Array) -> Array:
        inside = np.sqrt(1 - (1 - view.cosine**2) / index**2)
        return path + strength * index * (1 / inside - 1)

    return Effect("incidence_angle", "path", change, 0.05)


def amplitude(rng: np.random.Generator) -> Effect:
    """A bench table of offset against amplitude: dark surfaces drift, bright ones bend."""
    knots = np.geomspace(0.008, 24.0, 12)
    table = -((knots / 0.06) ** -rng.uniform(0.5, 0.8)) + 0.4 / (1 + (0.6 / knots) ** 3)
    table += rng.normal(0, 0.04, len(knots))
    sign = rng.choice([-1.0, 1.0])

    def change(strength: float, view: View, path: Array) -> Array:
        return path + sign * strength * np.interp(
            np.log(view.relative_amplitude), np.log(knots), table
        )

    return Effect("amplitude", "path", change, 0.01)


def fixed_pattern(rng: np.random.Generator) -> Effect:
    """Every pixel has its own delay: heavy-tailed, partly shared with its neighbours."""
    seed = int(rng.integers(2**32))

    def change(strength: float, view: View, path: Array) -> Array:
        camera = view.world.camera
        draw = np.random.default_rng(seed).standard_t(4, (camera.height, camera.width)) / np.sqrt(2)
        shared = (
            draw + np.roll(draw, 1, 0) + np.roll(draw, 1, 1) + np.roll(draw, (1, 1), (0, 1))
        ) / 2
        return path + strength * (0.8 * draw + 0.6 * shared)

    return Effect("fixed_pattern", "path", change, 0.005)


def row_column_pattern(rng: np.random.Generator) -> Effect:
    """Column converters in banks of four, and rows with a delay that wanders down the image."""
    seed, banks = int(rng.integers(2**32)), rng.uniform(0.5, 1.5, 4)

    def change(strength: float, view: View, path: Array) -> Array:
        camera, draw = view.world.camera, np.random.default_rng(seed)
        columns = (
            banks[np.arange(camera.width) % 4] - banks.mean() + draw.normal(0, 0.5, camera.width)
        )
        wander = np.cumsum(draw.normal(0, 0.3, camera.height)) + draw.normal(0, 0.3, camera.height)
        position = np.arange(camera.height)
        rows = wander - np.polyval(np.polyfit(position, wander, 2), position)
        return path + strength * (columns + rows[:, None])

    return Effect("row_column_pattern", "path", change, 0.005)
