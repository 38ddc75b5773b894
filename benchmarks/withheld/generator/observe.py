"""From a world to correlation samples without noise."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import TypeVar

import numpy as np

from benchmarks.withheld.generator.camera import directions
from benchmarks.withheld.generator.conditions import NOMINAL_EXPOSURE
from benchmarks.withheld.generator.effect import Applied, Stage
from benchmarks.withheld.generator.rigid import Array, inverse
from benchmarks.withheld.generator.target import WALL_BEHIND, WHITE
from benchmarks.withheld.generator.world import World

Value = TypeVar("Value")
CONTRAST = 0.62  # modulated share of the returned light
RIM = 0.04  # metres at the target's rim that count as off target
WEAKEST = 0.01  # of a white target's amplitude at 1 m; darker pixels have no return


def _later() -> np.ndarray:
    return np.zeros(0)


@dataclass(frozen=True)
class View:
    """What every pixel sees; arrays (N, H, W) unless said otherwise."""

    world: World
    distance: Array = field(default_factory=_later)  # along the ray, metres
    target_distance: Array = field(default_factory=_later)  # the same, as if the target had no rim
    cosine: Array = field(default_factory=_later)  # of the angle of incidence
    x: Array = field(default_factory=_later)  # target coordinates, metres
    y: Array = field(default_factory=_later)
    on_target: np.ndarray = field(default_factory=_later)
    reflectivity: Array = field(default_factory=_later)
    amplitude: Array = field(default_factory=_later)  # electrons
    path: Array = field(default_factory=_later)  # the distance that the phase tells, metres
    phasor: np.ndarray = field(default_factory=_later)  # complex, electrons

    @property
    def relative_amplitude(self) -> Array:
        """Amplitude in units of a white target's at 1 m."""
        return self.amplitude / self.world.camera.sensitivity

    @property
    def used(self) -> np.ndarray:
        """Pixels on the target that return enough light."""
        return self.on_target & (self.relative_amplitude > WEAKEST)


def trace(world: World, effects: Sequence[Applied] = ()) -> View:
    """Follow every ray to the target: the geometry of a view."""
    view = View(world)
    poses = _changed("poses", effects, view, world.world_from_tool())
    slopes = _changed("rays", effects, view, np.stack(world.camera.slopes()))
    world_from_target = _changed("plane", effects, view, world.setup.world_from_target)
    target_from_camera = inverse(world_from_target) @ poses @ world.setup.tool_from_camera
    toward = np.einsum("nij,hwj->inhw", target_from_camera[:, :3, :3], directions(*slopes))
    origin = target_from_camera[:, :3, 3].T[:, :, None, None]
    distance = -origin[2] / toward[2]
    x, y = origin[0] + distance * toward[0], origin[1] + distance * toward[1]
    if any(applied.effect.stage == "relief" for applied in effects):
        height = _changed("relief", effects, replace(view, x=x, y=y), np.zeros_like(x))
        distance = distance + height / toward[2]
    beyond = world.target.beyond(x, y, 0.0)
    return View(
        world,
        distance=np.where(beyond, distance - WALL_BEHIND / toward[2], distance),
        target_distance=distance,
        cosine=-toward[2],
        x=x,
        y=y,
        on_target=~world.target.beyond(x, y, RIM),
    )


def look(world: World, effects: Sequence[Applied] = ()) -> View:
    """The view up to the phasors."""
    view = trace(world, effects)
    reflectivity = _footprint_mean(world, view.x, view.y)
    exposure = (world.conditions.exposure / NOMINAL_EXPOSURE)[:, None, None]
    column, row = world.pixel_position
    vignette = 1 - 0.22 * (column**2 + row**2) / 2
    light = world.camera.sensitivity * exposure * vignette * view.cosine / view.distance**2
    view = replace(view, reflectivity=reflectivity, amplitude=light * reflectivity / WHITE)
    base = world.setup.base
    error = (
        base.of_distance(view.distance)
        + base.of_pixel(column, row)
        + base.of_amplitude(view.relative_amplitude)
    )
    path = _changed("path", effects, view, view.distance + error)
    phasor = view.amplitude * np.exp(2j * np.pi / world.camera.unambiguous_range * path)
    view = replace(view, path=path, phasor=phasor)
    return replace(view, phasor=_changed("light", effects, view, phasor))


def taps_of(view: View, effects: Sequence[Applied] = ()) -> Array:
    """The four correlation samples (4, N, H, W), electrons."""
    mean = view.amplitude / CONTRAST + background(view)
    real, imaginary = np.real(view.phasor), np.imag(view.phasor)
    taps = np.stack([mean + real, mean - imaginary, mean - real, mean + imaginary])
    return _changed("taps", effects, view, taps)


def background(view: View) -> Array:
    """Unmodulated light (N, H, W) in a tap, electrons."""
    conditions, camera = view.world.conditions, view.world.camera
    return (
        0.35
        * camera.sensitivity
        * (conditions.ambient * conditions.exposure / NOMINAL_EXPOSURE)[:, None, None]
        * (view.reflectivity)
    )


def demodulate(taps: Array, unambiguous_range: float) -> tuple[Array, Array]:
    """Distance (N, H, W) in metres and amplitude in electrons."""
    real, imaginary = (taps[0] - taps[2]) / 2, (taps[3] - taps[1]) / 2
    phase = np.arctan2(imaginary, real) % (2 * np.pi)
    return phase / (2 * np.pi) * unambiguous_range, np.hypot(real, imaginary)


def _footprint_mean(world: World, x: Array, y: Array) -> Array:
    """Reflectivity averaged over 3x3 points of each pixel's footprint."""
    along, down = (
        (np.gradient(x, axis=2), np.gradient(y, axis=2)),
        (np.gradient(x, axis=1), np.gradient(y, axis=1)),
    )
    total = np.zeros_like(x)
    for u in (-1 / 3, 0, 1 / 3):
        for v in (-1 / 3, 0, 1 / 3):
            total += world.target.reflectivity(
                x + u * along[0] + v * down[0], y + u * along[1] + v * down[1]
            )
    return total / 9


def _changed(stage: Stage, effects: Sequence[Applied], view: View, value: Value) -> Value:
    for applied in effects:
        if applied.effect.stage == stage:
            value = applied.effect.change(applied.strength, view, value)
    return value
