"""Forms of what settings and surroundings do: exposure, heat, room, background light."""

from typing import Any

import numpy as np

from benchmarks.renewed.geometry import SPEED_OF_LIGHT, Array, Random
from benchmarks.renewed.signal_chain import Change, adding, background, form
from benchmarks.renewed.world import NOMINAL_US, World, heat

EXPOSED: dict[str, Any] = {"exposure": "random", "logged": ("integration_time_us",)}
STANDING: dict[str, Any] = {"moving": False}
ROOM: dict[str, Any] = {"moving": False, "logged": ("room_temperature_c",)}
LAMPS: dict[str, Any] = {"logged": ("ambient",)}


def _per_frame(values: Array) -> Change:
    """A path changed by a strength times a value of every frame (N,)."""
    return adding(values[:, None, None])


@form("integration_time", "path", 0.01, textbook=True, **EXPOSED)
def logarithm(rng: Random, world: World) -> Change:
    """The offset follows the logarithm of the exposure."""
    return _per_frame(rng.choice([-1.0, 1.0]) * np.log(world.conditions.exposure / NOMINAL_US))


@form("integration_time", "path", 0.02, **EXPOSED)
def driver_droop(rng: Random, world: World) -> Change:
    """The driver's voltage droops within an exposure: the mean of an exponential over it."""
    share = world.conditions.exposure / rng.uniform(200.0, 1500.0)
    return _per_frame(rng.choice([-1.0, 1.0]) * (1 - (1 - np.exp(-share)) / share))


@form("integration_time", "path", 0.01, **EXPOSED)
def setting_table(rng: Random, world: World) -> Change:
    """Every setting has an offset of its own, in no order."""
    _, which = np.unique(world.conditions.exposure, return_inverse=True)
    offsets = rng.permutation(np.linspace(-1, 1, which.max() + 1))
    return _per_frame((offsets + rng.normal(0, 0.2, len(offsets)))[which])


@form("warm_up", "path", 0.01, textbook=True, **STANDING)
def two_exponentials(rng: Random, world: World) -> Change:
    """Driver and sensor warm up, each at its own rate, and cool down in pauses."""
    fast, slow, share = rng.uniform(60, 200), rng.uniform(500, 1500), rng.uniform(0.3, 0.7)
    powered = world.conditions.powered
    cold = share * (1 - heat(world.way, powered, fast))
    cold = cold + (1 - share) * (1 - heat(world.way, powered, slow))
    return _per_frame(rng.choice([-1.0, 1.0]) * cold)


@form("warm_up", "path", 0.01, **STANDING)
def line_with_pauses(rng: Random, world: World) -> Change:
    """A straight rise to a plateau; a pause takes back a part of it at once."""
    t, pauses = world.way.seconds, world.way.pauses
    rise, back = max(t[-1] * rng.uniform(0.3, 0.7), 60.0), rng.uniform(0.2, 0.7)
    level, result, before = 0.0, [], 0.0
    for now, pause in zip(t, pauses, strict=True):
        level = min(level + (now - before - pause) / rise, 1.0)
        level *= 1 - back if pause else 1.0
        result.append(level)
        before = now
    return _per_frame(rng.choice([-1.0, 1.0]) * np.array(result))


@form("warm_up", "path", 0.01, **STANDING)
def fan(rng: Random, world: World) -> Change:
    """The camera's fan comes on once it is warm: the drift ends in a step back."""
    t = world.way.seconds
    at, soft = t[-1] * rng.uniform(0.2, 0.6), rng.uniform(10.0, 60.0)
    up = np.minimum(t / max(at, 1.0), 1.0) * rng.uniform(0.2, 0.8)
    step = 1 / (1 + np.exp(-np.clip((t - at) / soft, -50, 50)))
    return _per_frame(rng.choice([-1.0, 1.0]) * (up - step))


@form("room_temperature", "path", 0.01, textbook=True, **ROOM)
def lag(rng: Random, world: World) -> Change:
    """The electronics follow the room's temperature after a while."""
    t, room, constant = world.way.seconds, world.conditions.room, rng.uniform(60.0, 400.0)
    late = room.copy()
    for i in range(1, len(t)):
        late[i] += (late[i - 1] - room[i]) * np.exp(-(t[i] - t[i - 1]) / constant)
    return _per_frame(rng.choice([-1.0, 1.0]) * (late - late.mean()) / 3)


@form("room_temperature", "path", 0.01, **ROOM)
def bowl(rng: Random, world: World) -> Change:
    """Compensated at one temperature; off it the error grows by the square."""
    room = world.conditions.room
    at = rng.uniform(room.min(), room.max())
    return _per_frame(rng.choice([-1.0, 1.0]) * ((room - at) / 3) ** 2)


@form("room_temperature", "path", 0.01, **ROOM)
def coarse_sensor(rng: Random, world: World) -> Change:
    """Compensated with a thermometer of whole steps: what is left is a saw-tooth over a slope."""
    room, step = world.conditions.room, rng.uniform(1.0, 2.5)
    left = 0.3 * (room - room.mean()) - np.round(room / step) * step + room
    return _per_frame(rng.choice([-1.0, 1.0]) * left)


@form("ambient_light", "light", 0.05, textbook=True, **LAMPS)
def false_correlation(rng: Random, world: World) -> Change:
    """Background light correlates a little, for the taps of a pixel do not match."""
    turn, middle = np.exp(1j * rng.uniform(0, 2 * np.pi)), world.design.near + world.design.far
    per_hertz = 2j * np.pi / SPEED_OF_LIGHT * middle
    return adding(lambda view: background(view) * np.exp(per_hertz * view.frequency) * turn)


@form("ambient_light", "path", 0.05, **LAMPS)
def bias_shift(rng: Random, world: World) -> Change:
    """The background's charge delays the gates, by its share of all charge."""
    sign = rng.choice([-1.0, 1.0])
    return adding(lambda view: sign * background(view) / (background(view) + view.amplitude))


@form("ambient_light", "path", 0.01, **LAMPS)
def drained(rng: Random, world: World) -> Change:
    """A circuit drains the background from every pixel; its delay follows the lamp's logarithm."""
    lamp = np.log1p(world.conditions.ambient / rng.uniform(0.05, 0.4))
    return _per_frame(rng.choice([-1.0, 1.0]) * (lamp - lamp.mean()))
