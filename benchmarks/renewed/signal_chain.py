"""From a world to what its camera measures: geometry, light, samples, noise, masks.

An effect is a *form*: a change, of some strength, of one stage of the signal chain.
"""

import itertools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal, TypeVar

import numpy as np
from scipy import ndimage

from benchmarks.renewed.geometry import (
    SPEED_OF_LIGHT,
    Array,
    Random,
    directions,
    image_grid,
    inverse,
)
from benchmarks.renewed.world import CONTRAST, NOMINAL_US, READ_NOISE, WHITE, World

Stage = Literal["poses", "rays", "plane", "relief", "path", "light", "taps"]
Change = Callable[[float, Any, Any], Any]
Value = TypeVar("Value")

STEEPEST = np.cos(np.deg2rad(68.0))  # a pixel that looks flatter at the target is off it
FARTHEST_TIMES = 1.25  # of the farthest station: what is beyond is off the target
VIGNETTE = 0.3  # of the light is missing in the corners
LAMP = 0.15  # electrons of the logged background light at 1, over a bright pixel's
KERNELS = {
    "mean of 3x3": np.ones(3) / 3,
    "gauss of 1.2 pixels": np.exp(-0.5 * (np.arange(-3, 4) / 1.2) ** 2),
}
_LATER: Any = ()  # an array that a later step adds


@dataclass(frozen=True)
class Form:
    """One physical form of an effect.

    `draw(rng, world)` returns `change(strength, view, value)`, which returns the stage's value with
    the effect in it; at strength zero it returns it as it is. The value is, by stage: poses the
    true world_from_tool (N, 4, 4); rays the slopes x/z, y/z (2, H, W); plane world_from_target
    (N, 4, 4); relief the target's height (N, H, W), metres; path the measured length (N, H, W),
    metres; light the phasors (N, H, W) at `view.frequency`; taps the samples (4, N, H, W) there.

    Attributes:
        effect: What an engineer calls it: a name of the program's catalogue, or of none.
        name: What tells this form from the others.
        textbook: Whether it is the form that the literature writes first. The others are those
            that a catalogue may lack.
        draw: Draws one unit's version.
        guess: A strength that gives an error of millimetres.
        scaled: Whether the strength is scaled to a size; rendered light comes as it is.
        wanted: What the design must be like, see `draw_world`.
    """

    effect: str
    name: str
    stage: Stage
    textbook: bool
    draw: Callable[[Random, World], Change]
    guess: float
    scaled: bool
    wanted: Mapping[str, Any]


def form(
    effect: str,
    stage: Stage,
    guess: float = 1.0,
    *,
    textbook: bool = False,
    scaled: bool = True,
    **wanted: object,
) -> Callable[[Callable[[Random, Any], Change]], Form]:
    """Make a form, with the function's name, of a function that draws it."""
    return lambda draw: Form(effect, draw.__name__, stage, textbook, draw, guess, scaled, wanted)


def adding(field: Any) -> Change:  # noqa: ANN401 - an array, or a function of the view
    """The value of a stage plus the strength times a field, one of all views or one of each."""
    of_view: Callable[[Any], Any] = field if callable(field) else lambda _: field
    return lambda strength, view, value: value + strength * of_view(view)


@dataclass(frozen=True)
class Hook:
    """A form drawn, at a strength."""

    form: Form
    change: Change
    strength: float


@dataclass(frozen=True)
class View:
    """What every pixel sees; arrays (N, H, W) unless said otherwise."""

    world: World
    toward: Array = _LATER  # (N, H, W, 3) rays in the target's frame
    origin: Array = _LATER  # (N, 3) the camera in the target's frame
    distance: Array = _LATER  # metres along the ray
    cosine: Array = _LATER  # of the angle of incidence
    x: Array = _LATER  # metres on the target
    y: Array = _LATER
    within: np.ndarray = _LATER  # the ray meets the plane in range
    on_target: np.ndarray = _LATER
    reflectivity: Array = _LATER
    amplitude: Array = _LATER  # electrons
    path: Array = _LATER  # metres, with the base errors
    frequency: float = 0.0  # Hz, while light and taps are made
    bright: float = 1.0  # electrons of a bright pixel


@dataclass(frozen=True)
class Measured:
    """What the camera gives; arrays (N, H, W)."""

    view: View
    depth: Array  # radial, metres
    amplitude: Array  # electrons


def changed(stage: Stage, hooks: Sequence[Hook], view: View, value: Value) -> Value:
    """The value of a stage with what changes it."""
    for hook in hooks:
        if hook.form.stage == stage:
            value = hook.change(hook.strength, view, value)
    return value


def see(world: World, hooks: Sequence[Hook] = (), slopes: Array | None = None) -> View:
    """Follow the rays through slopes (2, H, W), usually those of the pixels."""
    view = View(world)
    poses = changed("poses", hooks, view, world.world_from_tool())
    if slopes is None:
        slopes = np.stack(world.sensor.lens.slopes())
    slopes = changed("rays", hooks, view, slopes)
    plane = np.broadcast_to(world.world_from_target, (world.frames, 4, 4))
    plane = changed("plane", hooks, view, plane)
    target_from_camera = inverse(plane) @ poses @ world.tool_from_camera
    toward = np.einsum("nij,hwj->nhwi", target_from_camera[:, :3, :3], directions(*slopes))
    view = _hit(replace(view, toward=toward, origin=target_from_camera[:, :3, 3]))
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
    for axis, wall in room.sides():
        o, r, at = (oy, ry, y) if axis else (ox, rx, x)
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
    column, row = image_grid(*view.distance.shape[1:])
    vignette = 1 - VIGNETTE * (column**2 + row**2) / 2
    exposure = (world.conditions.exposure / NOMINAL_US)[:, None, None]
    light = world.sensor.lens.sensitivity * exposure * vignette * view.cosine / view.distance**2
    amplitude = light * shine / WHITE
    bright = float(np.quantile(amplitude[view.on_target], 0.98))
    view = replace(view, reflectivity=shine, amplitude=amplitude, bright=bright)
    base = world.sensor.base.at(view.distance, amplitude / bright)
    return replace(view, path=changed("path", hooks, view, view.distance + base))


def _footprint(view: View) -> Array:
    """Reflectivity averaged over four points of each pixel's footprint."""
    surface, total = view.world.surface, np.zeros_like(view.x)
    if set(surface.kind) == {"white"}:
        return surface.reflectivity(view.x, view.y)
    xs, ys = np.gradient(view.x, axis=(1, 2)), np.gradient(view.y, axis=(1, 2))
    for u, v in itertools.product((-0.25, 0.25), repeat=2):
        x, y = view.x + u * xs[0] + v * xs[1], view.y + u * ys[0] + v * ys[1]
        total += surface.reflectivity(x, y)
    return total / 4


def measure(world: World, hooks: Sequence[Hook] = (), rng: Random | None = None) -> Measured:
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


def _noise(rng: Random, taps: Array, world: World) -> Array:
    """Shot and read noise as the camera's filters leave it: they act on nothing else here.

    A filter that also blurs the picture would be an effect; this one leaves neighbours and
    successive frames of a pose with noise in common.
    """
    sensor = world.sensor
    if np.isinf(sensor.tail):
        white = rng.standard_normal(taps.shape)
    else:
        white = rng.standard_t(sensor.tail, taps.shape) * np.sqrt((sensor.tail - 2) / sensor.tail)
    white = white * np.sqrt(np.maximum(taps, 0) + READ_NOISE**2)
    if sensor.spatial_filter != "none":
        white = _smooth(white, KERNELS[sensor.spatial_filter])
    keep, pose_id = sensor.temporal_filter, world.way.pose_id
    for i in range(1, white.shape[1] if keep else 0):
        if pose_id[i] == pose_id[i - 1]:
            white[:, i] = keep * white[:, i - 1] + np.sqrt(1 - keep**2) * white[:, i]
    return white


def _smooth(values: Array, kernel: Array) -> Array:
    """Convolve the last two axes; the border is mirrored."""
    for axis in (-1, -2):
        values = ndimage.convolve1d(values, kernel / kernel.sum(), axis, mode="mirror")
    return values


# How strong a form must be for the error that is asked for.

TOLERANCE = 0.01  # of the logarithm of a size
STEPS = 14
COARSE = 9  # rows and columns of the grid on which light is rendered


def scaled(world: World, form: Form, change: Change, size: float) -> Hook:
    """The form at the strength at which its error's RMS over the target is `size` metres.

    A form that cannot become so large is returned at the nearest size met. What is rendered comes
    at strength 1.
    """
    if not form.scaled:
        return Hook(form, change, 1.0)
    clean = measure(world)

    def size_at(strength: float) -> float:
        error = field_of(measure(world, [Hook(form, change, strength)]), clean)
        return float(np.sqrt(np.mean(error[clean.view.on_target] ** 2)))

    return Hook(form, change, strength_for(size_at, form.guess, size))


def strength_for(size_at: Callable[[float], float], guess: float, size: float) -> float:
    """The strength at which `size_at` is nearest to a size, by proportion and then by halving."""
    strength, low, high, best = guess, None, None, (np.inf, guess)
    for _ in range(STEPS):
        miss = float(np.log(max(size_at(strength), 1e-9) / size))
        best = min(best, (abs(miss), strength))
        if abs(miss) < TOLERANCE:
            break
        low, high = (strength, high) if miss < 0 else (low, strength)
        if low is None or high is None:
            strength *= float(np.clip(np.exp(-miss), 0.2, 5.0))
        else:
            strength = float(np.sqrt(low * high))
    return best[1]


def field_of(changed: Measured, clean: Measured) -> Array:
    """Change of the measured depth (N, H, W), metres; zero where either does not see the target."""
    both = changed.view.on_target & clean.view.on_target
    return np.where(both, changed.depth - clean.depth, 0.0)


def coarse_points(world: World) -> Array:
    """Points on the target's plane (N, 9, 9, 3), in its frame, that an even grid of pixels sees."""
    slopes = np.stack(world.sensor.lens.slopes())
    rows, columns = (np.linspace(0, n - 1, COARSE).round().astype(int) for n in slopes.shape[1:])
    view = see(world, slopes=slopes[:, rows[:, None], columns])
    return np.stack([view.x, view.y, np.zeros_like(view.x)], axis=-1)


# Which pixels are said to look at the target: exactly, or as a plane fit finds them.

UNERODED = "RANSAC, no margin"  # with the pixels at edges, for effects that live there
TRIALS = 40
SAMPLE = 400  # pixels on which a trial is judged
MOST_EMPTY = 20  # pixels in the region marked: with fewer the frame is left out
NOISE_TIMES = 3.0  # the threshold is at least so many times the scatter


def mask_of(rng: Random, seen: Measured, depth: Array, kind: str, threshold: float) -> np.ndarray:
    """The mask (N, H, W) of measured depths with NaN where nothing returned."""
    if kind == "all that is seen":
        return seen.view.on_target
    margin, found, within = 2, seen.view.on_target, np.ones_like(seen.view.within)
    if kind.startswith("RANSAC"):
        margin, rays = 0 if kind == UNERODED else 2, seen.view.world.sensor.lens.rays()
        pairs = zip(depth, found, strict=True)
        planes = [_plane_pixels(rng, rays * d[..., None], near, threshold) for d, near in pairs]
        found, within = np.stack(planes), seen.view.within
    cross = ndimage.generate_binary_structure(2, 1)[None]  # neighbours along rows and columns
    for _ in range(margin):
        found = ndimage.binary_erosion(found, cross, border_value=1)
    return found & within


def _plane_pixels(rng: Random, points: Array, about: np.ndarray, threshold: float) -> np.ndarray:
    """Pixels (H, W) within the threshold of the plane that most of a marked region agrees with.

    The region keeps the search from the wall behind a board; the pixels found may lie anywhere.
    """
    known = np.isfinite(points).all(-1)
    if (known & about).sum() < MOST_EMPTY:
        return np.zeros_like(known)
    cloud = points[known & about]
    few = cloud[rng.integers(len(cloud), size=SAMPLE)]
    best, most = (np.array([0.0, 0.0, 1.0]), 0.0), -1
    for _ in range(TRIALS):
        a, b, c = few[rng.integers(SAMPLE, size=3)]
        normal = np.cross(b - a, c - a)
        if length := np.linalg.norm(normal):
            plane = normal / length, float(normal @ a / length)
            count = int((np.abs(few @ plane[0] - plane[1]) < threshold).sum())
            best, most = (plane, count) if count > most else (best, most)
    normal, offset = best
    for _ in range(2):
        near = cloud[np.abs(cloud @ normal - offset) < threshold]
        if len(near) >= 10:
            middle = near.mean(0)
            normal = np.linalg.eigh((near - middle).T @ (near - middle))[1][:, 0]
            offset = float(normal @ middle)
    off = np.abs(np.nan_to_num(points) @ normal - offset)
    scatter = 1.48 * np.median(off[known & (off < threshold)])
    return known & (off < max(threshold, NOISE_TIMES * scatter))
