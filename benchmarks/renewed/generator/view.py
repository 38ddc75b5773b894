"""What every pixel sees: geometry, light, and the path that the phase tells."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import TypeVar

import numpy as np

from benchmarks.renewed.generator.conditions import NOMINAL_US
from benchmarks.renewed.generator.form import Hook, Stage
from benchmarks.renewed.generator.surface import WHITE
from benchmarks.renewed.generator.world import World
from benchmarks.withheld.generator.camera import directions
from benchmarks.withheld.generator.rigid import Array, inverse

Value = TypeVar("Value")
STEEPEST = np.cos(np.deg2rad(68.0))  # a pixel that looks flatter at the target is off it
FARTHEST_TIMES = 1.25  # of the farthest station: what is beyond is off the target
VIGNETTE = 0.3  # of the light is missing in the corners


def _later() -> np.ndarray:
    return np.zeros(0)


@dataclass(frozen=True)
class View:
    """Arrays (N, H, W) unless said otherwise."""

    world: World
    toward: Array = field(default_factory=_later)  # (N, H, W, 3) rays in the target's frame
    origin: Array = field(default_factory=_later)  # (N, 3) the camera in the target's frame
    distance: Array = field(default_factory=_later)  # metres along the ray
    cosine: Array = field(default_factory=_later)  # of the angle of incidence
    x: Array = field(default_factory=_later)  # metres on the target
    y: Array = field(default_factory=_later)
    within: np.ndarray = field(default_factory=_later)  # the ray meets the plane in range
    on_target: np.ndarray = field(default_factory=_later)
    reflectivity: Array = field(default_factory=_later)
    amplitude: Array = field(default_factory=_later)  # electrons
    path: Array = field(default_factory=_later)  # metres, with the base errors
    frequency: float = 0.0  # Hz, while light and taps are made
    bright: float = 1.0  # electrons of a bright pixel


def see(world: World, hooks: Sequence[Hook] = (), slopes: Array | None = None) -> View:
    """Follow the rays through slopes (2, H, W), usually those of the pixels."""
    view = View(world)
    poses = changed("poses", hooks, view, world.world_from_tool())
    if slopes is None:
        slopes = np.stack(world.sensor.lens.slopes())
    slopes = changed("rays", hooks, view, slopes)
    plane = np.broadcast_to(world.world_from_target, (world.frames, 4, 4))
    target_from_camera = (
        inverse(changed("plane", hooks, view, plane)) @ poses @ world.tool_from_camera
    )
    toward = np.einsum("nij,hwj->nhwi", target_from_camera[:, :3, :3], directions(*slopes))
    view = replace(view, toward=toward, origin=target_from_camera[:, :3, 3])
    view = _hit(view)
    if any(hook.form.stage == "relief" for hook in hooks):
        height = changed("relief", hooks, view, np.zeros_like(view.distance))
        moved = view.distance + height / np.minimum(toward[..., 2], -STEEPEST)
        view = replace(view, distance=np.where(view.on_target, moved, view.distance))
    return _lit(view, hooks)


def _hit(view: View) -> View:
    """Where rays end: target, floor, side wall, or the wall behind a board."""
    surface, room = view.world.surface, view.world.surface.room
    ox, oy, oz = (view.origin[:, i, None, None] for i in range(3))
    rx, ry, rz = np.moveaxis(view.toward, -1, 0)
    steep = np.minimum(rz, -0.05)
    distance = -oz / steep
    x, y = ox + distance * rx, oy + distance * ry
    cosine, other = -rz, (np.abs(x) > surface.half[0]) | (np.abs(y) > surface.half[1])
    far, facing = (-surface.behind - oz) / steep, -rz
    walls = ((room.floor, oy, ry, y), (room.ceiling, oy, ry, y), (room.side, ox, rx, x))
    for wall, o, r, at in (*walls, (room.other_side, ox, rx, x)):
        if wall is None:
            continue
        beyond = at * np.sign(wall) > abs(wall)
        there = np.divide(wall - o, r, out=np.full_like(r, np.inf), where=np.abs(r) > 1e-6)
        nearer = beyond & (~other | (there < far))
        far, facing = np.where(nearer, there, far), np.where(nearer, np.abs(r), facing)
        other = other | beyond
    reach = FARTHEST_TIMES * view.world.design.far
    within = (-rz > STEEPEST) & (distance < reach)
    return replace(
        view,
        distance=np.where(other, np.clip(far, 0.05, 2 * reach), np.minimum(distance, 2 * reach)),
        cosine=np.clip(np.where(other, facing, cosine), 0.02, 1.0),
        x=np.clip(x, -20, 20),
        y=np.clip(y, -20, 20),
        within=within,
        on_target=within & ~other,
    )


def _lit(view: View, hooks: Sequence[Hook]) -> View:
    """Reflectivity, amplitude, and the path with base errors and what changes it."""
    world = view.world
    shine = np.where(view.on_target, _footprint(view), 0.5)
    column, row = np.meshgrid(*(np.linspace(-1, 1, n) for n in view.distance.shape[:0:-1]))
    vignette = 1 - VIGNETTE * (column**2 + row**2) / 2
    exposure = (world.conditions.exposure / NOMINAL_US)[:, None, None]
    light = world.sensor.lens.sensitivity * exposure * vignette * view.cosine / view.distance**2
    amplitude = light * shine / WHITE
    bright = float(np.quantile(amplitude[view.on_target], 0.98))
    view = replace(view, reflectivity=shine, amplitude=amplitude, bright=bright)
    base = replace(world.sensor.base, bright=bright).at(view.distance, amplitude)
    return replace(view, path=changed("path", hooks, view, view.distance + base))


def _footprint(view: View) -> Array:
    """Reflectivity averaged over four points of each pixel's footprint."""
    surface, total = view.world.surface, np.zeros_like(view.x)
    if set(surface.kind) == {"white"}:
        return surface.reflectivity(view.x, view.y)
    xs, ys = np.gradient(view.x, axis=(1, 2)), np.gradient(view.y, axis=(1, 2))
    for u in (-0.25, 0.25):
        for v in (-0.25, 0.25):
            total += surface.reflectivity(
                view.x + u * xs[0] + v * xs[1], view.y + u * ys[0] + v * ys[1]
            )
    return total / 4


def changed(stage: Stage, hooks: Sequence[Hook], view: View, value: Value) -> Value:
    """The value of a stage with what changes it."""
    for hook in hooks:
        if hook.form.stage == stage:
            value = hook.change(hook.strength, view, value)
    return value
