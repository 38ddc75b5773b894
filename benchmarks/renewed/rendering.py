# pyright: reportMissingImports=false
"""Light transport by a third party: Mitsuba with mitransient, both of the extra `renewed`.

mitransient's path integrator follows the light; here its contributions are sorted by the length of
their path. Those as long as there and back are the direct light, which the signal chain has
without noise from its geometry: they are kept as one sum, and the rest as a histogram over it.
"""

import hashlib
import os
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.renewed.geometry import SPEED_OF_LIGHT

REACH = 12.0  # metres that floor, walls and target extend; beyond every camera of the ranges


@dataclass(frozen=True)
class Room:
    """What stands around the target; None where there is nothing.

    Attributes:
        floor: Height y of the floor, metres below the target's origin (negative).
        side: Position x of a side wall; its sign says on which side it stands.
        other_side: Position x of a second side wall.
        ceiling: Height y of the ceiling.
        back: Distance z of a wall behind the camera.
        target_albedo: Reflectivity of the target.
        albedo: Reflectivity of everything else.
        gloss: Roughness of a glossy side wall, or 0 where it is diffuse.
    """

    floor: float | None = None
    side: float | None = None
    other_side: float | None = None
    ceiling: float | None = None
    back: float | None = None
    target_albedo: float = 0.7
    albedo: float = 0.5
    gloss: float = 0.0

    def walls(self) -> dict[str, tuple[int, float]]:
        """Axis and position of every wall that is there."""
        axes = {"floor": 1, "ceiling": 1, "side": 0, "other_side": 0, "back": 2}
        placed = {name: (axis, getattr(self, name)) for name, axis in axes.items()}
        return {name: wall for name, wall in placed.items() if wall[1] is not None}

    def sides(self) -> list[tuple[int, float]]:
        """Axis and position of those beside the way from camera to target."""
        return [(axis, at) for axis, at in self.walls().values() if axis < 2]


def scene_of(room: Room, camera: np.ndarray) -> dict[str, Any]:
    """Mitsuba's description of a room, lit by a spot at the camera (target_from_camera, 4x4)."""
    import mitsuba as mi

    diffuse = {"type": "diffuse", "reflectance": _grey(room.albedo)}
    rough = {"type": "roughplastic", "distribution": "ggx", "alpha": room.gloss}
    glossy = {**rough, "diffuse_reflectance": _grey(room.albedo)}
    parts: dict[str, Any] = {
        "type": "scene",
        "integrator": {"type": "transient_path", "max_depth": 8, "rr_depth": 5},
        "light": {  # the camera's own: a cone of 100 degrees that fades towards its rim
            "type": "spot",
            "to_world": mi.ScalarTransform4f(camera.tolist()),
            "intensity": _grey(1.0),
            "cutoff_angle": 50.0,
            "beam_width": 38.0,
        },
        "target": {
            "type": "rectangle",
            "to_world": mi.ScalarTransform4f().scale(REACH),
            "bsdf": {"type": "diffuse", "reflectance": _grey(room.target_albedo)},
        },
    }
    for name, (axis, position) in room.walls().items():
        shiny = name == "side" and room.gloss > 0
        parts[name] = {
            "type": "rectangle",
            "to_world": mi.ScalarTransform4f(_placed(axis, position).tolist()),
            "bsdf": glossy if shiny else diffuse,
        }
    return parts


def _grey(value: float) -> dict[str, Any]:
    return {"type": "rgb", "value": value}


def _placed(axis: int, position: float) -> np.ndarray:
    """Transform (4, 4) of the unit square, whose normal is z, to a wall that faces the origin."""
    normal = np.zeros(3)
    normal[axis] = -np.sign(position)
    along = np.roll(np.abs(normal), 1)
    result = np.eye(4)
    result[:3, :3] = REACH * np.stack([along, np.cross(normal, along), normal], axis=1)
    result[axis, 3] = position
    return result


Light = Any  # an array of drjit
Scene = Any  # of mitsuba
Rays = Any  # of mitsuba
Add = Callable[[Light, Light, object, Light], None]  # light, path's length, wavelengths, active
VARIANT = "llvm_ad_rgb"


def start_renderer() -> None:
    """Choose the renderer's kind of numbers and register mitransient's integrators."""
    import mitsuba as mi

    if mi.variant() != VARIANT:
        mi.set_variant(VARIANT)
    import mitransient  # noqa: F401


def traced(scene: Scene, rays: Rays, seed: int, add: Add) -> Light:
    """Return the radiance of rays; `add` is called with every contribution.

    What `add` sums is a side effect of the radiance: evaluate both together.
    """
    import drjit as dr
    import mitsuba as mi

    sampler = mi.load_dict({"type": "independent"})
    # Of one ray from one place all paths would be the same.
    sampler.seed(seed, max(dr.width(rays.o), dr.width(rays.d)))
    return scene.integrator().sample(
        mode=dr.ADMode.Primal,
        scene=scene,
        sampler=sampler,
        ray=rays,
        depth=mi.UInt32(0),
        β=mi.Spectrum(1),
        δL=None,
        state_in=None,
        active=mi.Bool(True),
        add_transient=add,
    )[0]


def cached(key: str, make: Callable[[], np.ndarray]) -> np.ndarray:
    """The array that was made for a key before, or is made now."""
    folder = Path(os.environ.get("TOFCORR_RENDERED", Path(tempfile.gettempdir()) / "rendered"))
    file = folder / f"{hashlib.sha256(key.encode()).hexdigest()[:24]}.npy"
    if file.exists():
        return np.load(file)
    array = make()
    folder.mkdir(parents=True, exist_ok=True)
    part = file.with_suffix(f".{os.getpid()}.part.npy")
    np.save(part, array)
    part.rename(file)
    return array


BIN = 0.02  # metres of path; at 100 MHz 2.4 degrees of phase of a term of a tenth: 0.1 mm at most
BINS = 1200  # paths up to 24 m
DIRECT_WITHIN = 1e-3  # metres of path by which direct light may differ, in single precision


def phasors(histogram: np.ndarray, frequency: float) -> np.ndarray:
    """Sum over a histogram (K, BINS), relative to the direct light, at a modulation frequency."""
    extra = (np.arange(BINS) + 0.5) * BIN
    return histogram @ np.exp(2j * np.pi * frequency / SPEED_OF_LIGHT * extra)


class Renderer:
    """One room, seen from one camera after another."""

    def __init__(self, room: Room) -> None:
        import mitsuba as mi

        start_renderer()
        self._scene: Scene = mi.load_dict(scene_of(room, np.eye(4)))
        self._parameters: Any = mi.traverse(self._scene)

    def at(self, camera: np.ndarray, points: np.ndarray, samples: int, seed: int) -> np.ndarray:
        """Render the light at points (K, 3) of the target with light and eye at a camera (4, 4).

        Returns:
            Indirect light as a share of the direct light, by additional path, (K, BINS).
        """
        import drjit as dr
        import mitsuba as mi

        # Opaque numbers: as literals they would be compiled into a kernel of each camera's own.
        here = mi.Transform4f(camera.tolist())
        dr.make_opaque(here)
        self._parameters["light.to_world"] = here
        self._parameters.update()
        start = mi.Point3f(*map(float, camera[:3, 3]))
        dr.make_opaque(start)
        origin, count = camera[:3, 3], len(points)
        toward = points - origin
        length = np.linalg.norm(toward, axis=-1)
        index = dr.arange(mi.UInt32, count * samples) // samples
        ahead = mi.Vector3f((toward / length[:, None]).T)
        rays = mi.Ray3f(start, dr.gather(mi.Vector3f, ahead, index))
        there_and_back = dr.gather(mi.Float, mi.Float(2 * length), index)
        direct = dr.zeros(mi.Float, count)
        bins = dr.zeros(mi.Float, count * BINS)

        def add(spec: Light, distance: Light, _wavelengths: object, active: Light) -> None:
            extra = distance - there_and_back
            light = spec.x / samples
            first = active & (extra < DIRECT_WITHIN)
            later = active & ~first & (extra < BIN * BINS)
            dr.scatter_reduce(dr.ReduceOp.Add, direct, light, index, first)
            where = index * BINS + mi.UInt32(dr.select(later, extra / BIN, 0.0))
            dr.scatter_reduce(dr.ReduceOp.Add, bins, light, where, later)

        radiance = traced(self._scene, rays, seed, add)
        dr.eval(radiance, direct, bins)
        base = np.array(direct)
        if not (base > 0).all():
            raise RuntimeError("the renderer returned no direct light at some points of the target")
        return np.array(bins).reshape(count, BINS) / base[:, None]


PATHS = 2048  # paths a point: leaves 3 % of the indirect light as noise, before `smooth`
DEGREE = 4  # of the polynomial over the image that takes off the noise


def indirect(
    room: Room, cameras: np.ndarray, points: np.ndarray, frequencies: Sequence[float], seed: int
) -> np.ndarray:
    """Phasors (F, N, R, C) of indirect light over direct light.

    Args:
        room: What stands around the target.
        cameras: target_from_camera (N, 4, 4).
        points: Where each camera looks, on the target (N, R, C, 3).
        frequencies: Hz (F,).
        seed: Of the paths.
    """
    text = hashlib.sha256(cameras.tobytes() + points.tobytes()).hexdigest()
    key = f"1 {room} {text} {tuple(frequencies)} {seed} {PATHS}"
    return cached(key, lambda: _rendered(room, cameras, points, frequencies, seed))


def _rendered(
    room: Room, cameras: np.ndarray, points: np.ndarray, frequencies: Sequence[float], seed: int
) -> np.ndarray:
    renderer, result = Renderer(room), []
    for number, (camera, at) in enumerate(zip(cameras, points, strict=True)):
        light = renderer.at(camera, at.reshape(-1, 3), PATHS, seed + number)
        result.append([phasors(light, frequency) for frequency in frequencies])
    return np.stack(result, axis=1).reshape(len(frequencies), *points.shape[:3])


def smooth(values: np.ndarray, rows: np.ndarray, columns: np.ndarray) -> np.ndarray:
    """Polynomial through values (..., R, C) of an even grid, at rows (H,) and columns (W,).

    Positions go from -1 to 1. Indirect light varies slowly; the noise of its paths does not.
    """
    high, wide = values.shape[-2:]
    down, along = np.meshgrid(np.linspace(-1, 1, high), np.linspace(-1, 1, wide), indexing="ij")
    fit = np.linalg.pinv(_terms(down.ravel(), along.ravel()))
    v, u = np.meshgrid(rows, columns, indexing="ij")
    weights = _terms(v.ravel(), u.ravel()) @ fit
    result = values.reshape(*values.shape[:-2], -1) @ weights.T
    return result.reshape(*values.shape[:-2], len(rows), len(columns))


def _terms(v: np.ndarray, u: np.ndarray) -> np.ndarray:
    powers = [(i, j) for i in range(DEGREE + 1) for j in range(DEGREE + 1 - i)]
    return np.stack([v**i * u**j for i, j in powers], axis=-1)


COSINES = np.linspace(0.3, 1.0, 15)
DISTANCE = 2000.0  # of camera and light, mean free paths
SPOT = np.array([37.0, 11.0, 0.0])  # where the ray meets the slab: on no edge of its triangles
THICK = 60.0  # mean free paths
SAMPLES = 1 << 16  # paths an angle
LANES = 64  # sums side by side
COMPLETE_WITHIN = 0.01  # of the radiance must be in the sums


def delays(albedo: float, forward: float) -> np.ndarray:
    """Mean extra distance (15,) at `COSINES`, in mean free paths.

    Args:
        albedo: Of a single scattering.
        forward: Mean cosine of a scattering (Henyey-Greenstein).
    """
    return cached(f"slab 2 {albedo} {forward} {SAMPLES}", lambda: _rendered_delays(albedo, forward))


def _rendered_delays(albedo: float, forward: float) -> np.ndarray:
    start_renderer()
    return np.array([delay_at(albedo, forward, float(c), i) for i, c in enumerate(COSINES)])


def delay_at(albedo: float, forward: float, cosine: float, seed: int) -> float:
    """Mean extra distance at the cosine of an angle, in mean free paths."""
    import drjit as dr
    import mitsuba as mi

    toward = -np.array([np.sqrt(1 - cosine**2), 0.0, cosine])
    where = SPOT - DISTANCE * toward
    scene: Any = mi.load_dict(_slab(albedo, forward, where))
    lane = dr.arange(mi.UInt32, SAMPLES) % LANES
    start = mi.Point3f(*map(float, where)) + dr.zeros(mi.Float, SAMPLES)
    rays = mi.Ray3f(start, mi.Vector3f(*map(float, toward)))
    light, later = dr.zeros(mi.Float, LANES), dr.zeros(mi.Float, LANES)

    def add(spec: Light, distance: Light, _wavelengths: object, active: Light) -> None:
        extra = distance / 2 - DISTANCE
        dr.scatter_reduce(dr.ReduceOp.Add, light, spec.x, lane, active)
        dr.scatter_reduce(dr.ReduceOp.Add, later, spec.x * extra, lane, active)

    scene.integrator().prepare_scene(scene)
    radiance = traced(scene, rays, seed, add)
    dr.eval(radiance, light, later)
    total, everything = light.numpy().sum(), mi.luminance(radiance).numpy().sum()
    if not abs(total - everything) < COMPLETE_WITHIN * everything:
        raise RuntimeError(f"the renderer lost light: {total:.3g} of {everything:.3g} came")
    return float(later.numpy().sum() / total)


def _slab(albedo: float, forward: float, where: np.ndarray) -> dict[str, Any]:
    import mitsuba as mi

    wide = mi.ScalarTransform4f().translate([0, 0, -THICK / 2]).scale([5e4, 5e4, THICK / 2])
    return {
        "type": "scene",
        "integrator": {"type": "transient_prbvolpath", "max_depth": 200, "rr_depth": 60},
        "light": {"type": "point", "position": where.tolist(), "intensity": _grey(1e6)},
        "slab": {
            "type": "cube",
            "to_world": wide,
            "bsdf": {"type": "null"},
            "interior": {
                "type": "homogeneous",
                "albedo": _grey(albedo),
                "sigma_t": 1.0,
                "phase": {"type": "hg", "g": forward},
            },
        },
    }
