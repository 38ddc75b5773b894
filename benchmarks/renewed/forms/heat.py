"""Forms of what settings and surroundings do: exposure, heat, room, background light."""

import numpy as np

from benchmarks.renewed.generator.conditions import NOMINAL_US, heat
from benchmarks.renewed.generator.form import Change, Form
from benchmarks.renewed.generator.measure import background
from benchmarks.renewed.generator.view import View
from benchmarks.renewed.generator.world import World
from benchmarks.withheld.generator.camera import SPEED_OF_LIGHT
from benchmarks.withheld.generator.rigid import Array

EXPOSED = {"exposure": "random", "logged": ("integration_time_us",)}
STANDING = {"moving": False}
ROOM = {"moving": False, "logged": ("room_temperature_c",)}
LAMPS = {"logged": ("ambient",)}


def _per_frame(values: Array) -> Change:
    """A path changed by a strength times a value of every frame (N,)."""

    def change(strength: float, view: View, path: Array) -> Array:
        return path + strength * values[:, None, None]

    return change


def logarithm(rng: np.random.Generator, world: World) -> Change:
    """The offset follows the logarithm of the exposure."""
    return _per_frame(rng.choice([-1.0, 1.0]) * np.log(world.conditions.exposure / NOMINAL_US))


def driver_droop(rng: np.random.Generator, world: World) -> Change:
    """The driver's voltage droops within an exposure: the mean of an exponential over it."""
    share = world.conditions.exposure / rng.uniform(200.0, 1500.0)
    return _per_frame(rng.choice([-1.0, 1.0]) * (1 - (1 - np.exp(-share)) / share))


def setting_table(rng: np.random.Generator, world: World) -> Change:
    """Every setting has an offset of its own, in no order."""
    _, which = np.unique(world.conditions.exposure, return_inverse=True)
    offsets = rng.permutation(np.linspace(-1, 1, which.max() + 1))
    return _per_frame((offsets + rng.normal(0, 0.2, len(offsets)))[which])


def two_exponentials(rng: np.random.Generator, world: World) -> Change:
    """Driver and sensor warm up, each at its own rate, and cool down in pauses."""
    fast, slow, share = rng.uniform(60, 200), rng.uniform(500, 1500), rng.uniform(0.3, 0.7)
    powered = world.conditions.powered
    cold = share * (1 - heat(world.way, powered, fast))
    cold = cold + (1 - share) * (1 - heat(world.way, powered, slow))
    return _per_frame(rng.choice([-1.0, 1.0]) * cold)


def line_with_pauses(rng: np.random.Generator, world: World) -> Change:
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


def fan(rng: np.random.Generator, world: World) -> Change:
    """The camera's fan comes on once it is warm: the drift ends in a step back."""
    t = world.way.seconds
    at, soft = t[-1] * rng.uniform(0.2, 0.6), rng.uniform(10.0, 60.0)
    up = np.minimum(t / max(at, 1.0), 1.0) * rng.uniform(0.2, 0.8)
    return _per_frame(
        rng.choice([-1.0, 1.0]) * (up - 1 / (1 + np.exp(-np.clip((t - at) / soft, -50, 50))))
    )


def lag(rng: np.random.Generator, world: World) -> Change:
    """The electronics follow the room's temperature after a while."""
    t, room, constant = world.way.seconds, world.conditions.room, rng.uniform(60.0, 400.0)
    late = room.copy()
    for i in range(1, len(t)):
        late[i] += (late[i - 1] - room[i]) * np.exp(-(t[i] - t[i - 1]) / constant)
    return _per_frame(rng.choice([-1.0, 1.0]) * (late - late.mean()) / 3)


def bowl(rng: np.random.Generator, world: World) -> Change:
    """Compensated at one temperature; off it the error grows by the square."""
    room = world.conditions.room
    at = rng.uniform(room.min(), room.max())
    return _per_frame(rng.choice([-1.0, 1.0]) * ((room - at) / 3) ** 2)


def coarse_sensor(rng: np.random.Generator, world: World) -> Change:
    """Compensated with a thermometer of whole steps: what is left is a saw-tooth over a slope."""
    room, step = world.conditions.room, rng.uniform(1.0, 2.5)
    return _per_frame(
        rng.choice([-1.0, 1.0]) * (0.3 * (room - room.mean()) - np.round(room / step) * step + room)
    )


def false_correlation(rng: np.random.Generator, world: World) -> Change:
    """Background light correlates a little, for the taps of a pixel do not match."""
    turn, middle = np.exp(1j * rng.uniform(0, 2 * np.pi)), world.design.near + world.design.far

    def change(strength: float, view: View, phasor: np.ndarray) -> np.ndarray:
        at = np.exp(2j * np.pi * view.frequency / SPEED_OF_LIGHT * middle)
        return phasor + strength * background(view) * at * turn

    return change


def bias_shift(rng: np.random.Generator, world: World) -> Change:
    """The background's charge delays the gates, by its share of all charge."""
    sign = rng.choice([-1.0, 1.0])

    def change(strength: float, view: View, path: Array) -> Array:
        light = background(view)
        return path + sign * strength * light / (light + view.amplitude)

    return change


def drained(rng: np.random.Generator, world: World) -> Change:
    """A circuit drains the background from every pixel; its delay follows the lamp's logarithm."""
    lamp = np.log1p(world.conditions.ambient / rng.uniform(0.05, 0.4))
    return _per_frame(rng.choice([-1.0, 1.0]) * (lamp - lamp.mean()))


FORMS = (
    Form("integration_time", "logarithm", "path", True, logarithm, 0.01, wanted=EXPOSED),
    Form("integration_time", "driver_droop", "path", False, driver_droop, 0.02, wanted=EXPOSED),
    Form("integration_time", "setting_table", "path", False, setting_table, 0.01, wanted=EXPOSED),
    Form("warm_up", "two_exponentials", "path", True, two_exponentials, 0.01, wanted=STANDING),
    Form("warm_up", "line_with_pauses", "path", False, line_with_pauses, 0.01, wanted=STANDING),
    Form("warm_up", "fan", "path", False, fan, 0.01, wanted=STANDING),
    Form("room_temperature", "lag", "path", True, lag, 0.01, wanted=ROOM),
    Form("room_temperature", "bowl", "path", False, bowl, 0.01, wanted=ROOM),
    Form("room_temperature", "coarse_sensor", "path", False, coarse_sensor, 0.01, wanted=ROOM),
    Form(
        "ambient_light", "false_correlation", "light", True, false_correlation, 0.05, wanted=LAMPS
    ),
    Form("ambient_light", "bias_shift", "path", False, bias_shift, 0.05, wanted=LAMPS),
    Form("ambient_light", "drained", "path", False, drained, 0.01, wanted=LAMPS),
)
