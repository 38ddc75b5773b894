# pyright: reportMissingImports=false
"""Scenes with second bounces of light, rendered by Mitsuba and mitransient.

A frame takes one ray along the middle of each pixel. The light at the camera lights a cone. Direct
light alone and all bounces come from separate runs, so that what further bounces add is exact but
for the noise of the paths.
"""

import hashlib
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from benchmarks.renewed.geometry import SPEED_OF_LIGHT
from benchmarks.renewed.rendering import cached, start_renderer, traced
from tofcorr.geometry.camera import Matrix3

HEIGHT, WIDTH, FOCAL = 48, 64, 52.0  # pixels; 63 degrees wide, the corners 37 degrees off the axis
CONE = 48.0  # degrees off the axis that the light reaches; it is even up to 46
FREQUENCY = 20e6  # Hz; unambiguous up to 7.5 m
GAIN = 3000.0  # amplitude of a white wall at 1 m, counts, times pi
PATHS = 1024  # paths a pixel

Part = dict[str, Any]


@dataclass(frozen=True, kw_only=True)
class Frame:
    """What a camera sees, without noise.

    Attributes:
        name: Of the scene.
        distance: True, along the ray, metres (H, W).
        amplitude: Of the direct light alone, counts (H, W).
        ratio: Light of further bounces over the direct light, complex (H, W).
        normal: Of the surface, in the camera's axes (H, W, 3).
        shape: Number of the surface (H, W).
    """

    name: str
    distance: np.ndarray
    amplitude: np.ndarray
    ratio: np.ndarray
    normal: np.ndarray
    shape: np.ndarray

    @property
    def error(self) -> np.ndarray:
        """What further bounces add to the distance, metres (H, W)."""
        return np.angle(1 + self.ratio) * SPEED_OF_LIGHT / (4 * np.pi * FREQUENCY)


def matrix() -> Matrix3:
    """The camera."""
    return (FOCAL, 0.0, (WIDTH - 1) / 2), (0.0, FOCAL, (HEIGHT - 1) / 2), (0.0, 0.0, 1.0)


def rays() -> np.ndarray:
    """Unit rays of all pixels (H, W, 3)."""
    rows, columns = np.mgrid[:HEIGHT, :WIDTH].astype(float)
    across, down = (columns - (WIDTH - 1) / 2) / FOCAL, (rows - (HEIGHT - 1) / 2) / FOCAL
    ray = np.stack([across, down, np.ones_like(across)], axis=-1)
    return ray / np.linalg.norm(ray, axis=-1, keepdims=True)


def looking(eye: np.ndarray, at: np.ndarray, roll: float = 0.0) -> np.ndarray:
    """Pose world_from_camera (4, 4) of a camera at `eye` that looks at a place; z is up."""
    ahead = (at - eye) / np.linalg.norm(at - eye)
    right = np.cross(ahead, [0, 0, 1.0])
    right /= np.linalg.norm(right)
    down = np.cross(ahead, right)
    c, s = np.cos(roll), np.sin(roll)
    pose = np.eye(4)
    pose[:3, :3] = np.stack([c * right + s * down, c * down - s * right, ahead], axis=1)
    pose[:3, 3] = eye
    return pose


def panel(
    corner: tuple[float, ...], u: tuple[float, ...], v: tuple[float, ...], grey: float
) -> Part:
    """A rectangle from a corner along two sides, seen from both sides."""
    import mitsuba as mi

    first, second = np.array(u) / 2, np.array(v) / 2
    place = np.eye(4)
    normal = np.cross(first, second)
    place[:3, :3] = np.stack([first, second, normal / np.linalg.norm(normal)], axis=1)
    place[:3, 3] = np.array(corner) + first + second
    return _matt("rectangle", mi.ScalarTransform4f(place.tolist()), grey)


def _matt(kind: str, place: Any, grey: float, **more: Any) -> Part:  # noqa: ANN401
    colour = {"type": "rgb", "value": float(grey)}
    bsdf = {"type": "twosided", "material": {"type": "diffuse", "reflectance": colour}}
    return {"type": kind, "to_world": place, "bsdf": bsdf, **more}


def box(centre: tuple[float, ...], size: tuple[float, ...], turn: float, grey: float) -> Part:
    """A cuboid, turned about the vertical by degrees."""
    import mitsuba as mi

    half = [each / 2 for each in size]
    place = mi.ScalarTransform4f().translate(list(centre)).rotate([0, 0, 1], turn).scale(half)
    return _matt("cube", place, grey)


def tube(foot: tuple[float, ...], height: float, radius: float, grey: float) -> Part:
    """An upright cylinder."""
    import mitsuba as mi

    place = mi.ScalarTransform4f().translate(list(foot)).scale([radius, radius, height])
    return _matt("cylinder", place, grey)


Draw = np.random.Generator
Scene = tuple[dict[str, Part], list[np.ndarray]]


def _views(draw: Draw, count: int, eye: tuple, spread: tuple, at: tuple, aim: float) -> list:
    low = np.array(eye) - np.array(spread)
    return [
        looking(
            low + 2 * np.array(spread) * draw.random(3),
            np.array(at) + aim * draw.uniform(-1, 1, 3),
            draw.normal(0, 0.05),
        )
        for _ in range(count)
    ]


def corner(draw: Draw, views: int) -> Scene:
    """Two panels at a right angle, seen whole."""
    a, b = draw.uniform(0.4, 0.85, 2)
    w, h = draw.uniform(0.8, 1.1), draw.uniform(0.9, 1.2)
    parts = {
        "left": panel((0, 0, -h / 2), (w, 0, 0), (0, 0, h), a),
        "right": panel((0, 0, -h / 2), (0, w, 0), (0, 0, h), b),
    }
    return parts, _views(draw, views, (1.5, 1.5, 0.1), (0.2, 0.2, 0.25), (0.25, 0.25, 0), 0.03)


def three_panels(draw: Draw, views: int) -> Scene:
    """Three panels at right angles, seen whole."""
    a, b, c = draw.uniform(0.4, 0.85, 3)
    w = draw.uniform(0.75, 1.0)
    parts = {
        "left": panel((0, 0, 0), (w, 0, 0), (0, 0, w), a),
        "right": panel((0, 0, 0), (0, w, 0), (0, 0, w), b),
        "floor": panel((0, 0, 0), (w, 0, 0), (0, w, 0), c),
    }
    return parts, _views(draw, views, (1.5, 1.5, 1.2), (0.2, 0.2, 0.2), (0.25, 0.25, 0.25), 0.03)


def long_corner(draw: Draw, views: int) -> Scene:
    """A corner of two walls that runs past the image."""
    a, b = draw.uniform(0.4, 0.85, 2)
    parts = {
        "left": panel((0, 0, -4), (6, 0, 0), (0, 0, 8), a),
        "right": panel((0, 0, -4), (0, 6, 0), (0, 0, 8), b),
    }
    return parts, _views(draw, views, (1.5, 1.5, 0), (0.4, 0.4, 0.3), (0.3, 0.3, 0), 0.15)


def wall_and_floor(draw: Draw, views: int) -> Scene:
    """A wall with the floor mostly outside of the image."""
    a, b = draw.uniform(0.4, 0.85, 2)
    parts = {
        "wall": panel((-5, 0, 0), (10, 0, 0), (0, 0, 6), a),
        "floor": panel((-5, 0, 0), (10, 0, 0), (0, 8, 0), b),
    }
    eye, at = (0, 1.9, 0.95), (0, 0, 0.75)
    return parts, _views(draw, views, eye, (0.5, 0.4, 0.15), at, 0.08)


def wall_and_side(draw: Draw, views: int) -> Scene:
    """A wall with a bright side wall mostly outside of the image."""
    a, b = draw.uniform(0.4, 0.6), draw.uniform(0.7, 0.9)
    parts = {
        "wall": panel((0, 0, -3), (8, 0, 0), (0, 0, 6), a),
        "side": panel((0, 0, -3), (0, 8, 0), (0, 0, 6), b),
    }
    eye, at = (0.95, 1.8, 0), (0.85, 0, 0)
    return parts, _views(draw, views, eye, (0.15, 0.3, 0.4), at, 0.08)


def boxes(draw: Draw, views: int) -> Scene:
    """Boxes on a floor in front of a wall."""
    greys = draw.uniform(0.35, 0.85, 5)
    parts = {
        "wall": panel((-5, 0, 0), (10, 0, 0), (0, 0, 6), greys[0]),
        "floor": panel((-5, 0, 0), (10, 0, 0), (0, 8, 0), greys[1]),
    }
    for number, x in enumerate((-0.6, 0.1, 0.7)):
        size = draw.uniform(0.25, 0.5, 3)
        centre = (x, draw.uniform(0.35, 0.7), size[2] / 2)
        parts[f"box{number}"] = box(centre, tuple(size), draw.uniform(-40, 40), greys[2 + number])
    return parts, _views(draw, views, (0, 2.3, 1.2), (0.5, 0.2, 0.2), (0, 0.3, 0.4), 0.1)


def cupboard(draw: Draw, views: int) -> Scene:
    """An open cupboard with a board that hides a part of it."""
    g = draw.uniform(0.4, 0.85, 7)
    w, d, h = draw.uniform(0.9, 1.1), draw.uniform(0.5, 0.6), draw.uniform(0.8, 1.0)
    parts = {
        "back": panel((-w / 2, 0, 0), (w, 0, 0), (0, 0, h), g[0]),
        "left": panel((-w / 2, 0, 0), (0, d, 0), (0, 0, h), g[1]),
        "right": panel((w / 2, 0, 0), (0, d, 0), (0, 0, h), g[2]),
        "bottom": panel((-w / 2, 0, 0), (w, 0, 0), (0, d, 0), g[3]),
        "top": panel((-w / 2, 0, h), (w, 0, 0), (0, d, 0), g[4]),
        "board": panel((draw.uniform(-0.15, 0.15), 0.02, 0), (0, d, 0), (0, 0, 0.7 * h), g[5]),
    }
    return parts, _views(draw, views, (0, 1.7, 0.5), (0.35, 0.15, 0.25), (0, 0, 0.45), 0.05)


def cylinder(draw: Draw, views: int) -> Scene:
    """A cylinder on a floor before a wall."""
    g = draw.uniform(0.4, 0.85, 3)
    parts = {
        "wall": panel((-5, 0, 0), (10, 0, 0), (0, 0, 6), g[0]),
        "floor": panel((-5, 0, 0), (10, 0, 0), (0, 8, 0), g[1]),
        "tube": tube((draw.uniform(-0.3, 0.3), 0.4, 0), 0.9, draw.uniform(0.15, 0.25), g[2]),
    }
    return parts, _views(draw, views, (0, 2.2, 1.1), (0.5, 0.2, 0.2), (0, 0.2, 0.5), 0.1)


def slats(draw: Draw, views: int) -> Scene:
    """Upright slats before a wall."""
    g = draw.uniform(0.4, 0.85, 7)
    parts = {"wall": panel((-5, 0, -3), (10, 0, 0), (0, 0, 6), g[0])}
    for number in range(6):
        x = -0.75 + 0.3 * number + draw.uniform(-0.03, 0.03)
        far = draw.uniform(0.25, 0.45)
        parts[f"slat{number}"] = panel((x, far, -0.7), (0.12, 0, 0), (0, 0, 1.4), g[1 + number])
    return parts, _views(draw, views, (0, 1.9, 0), (0.4, 0.2, 0.3), (0, 0, 0), 0.1)


def lone_wall(draw: Draw, views: int) -> Scene:
    """A wall, and nothing else."""
    parts = {"wall": panel((-8, 0, -6), (16, 0, 0), (0, 0, 12), draw.uniform(0.4, 0.85))}
    return parts, _views(draw, views, (0, 1.8, 0), (0.8, 0.7, 0.5), (0, 0, 0), 0.3)


SCENES: dict[str, Callable[[Draw, int], Scene]] = {
    made.__name__: made
    for made in (
        corner,
        three_panels,
        long_corner,
        wall_and_floor,
        wall_and_side,
        boxes,
        cupboard,
        cylinder,
        slats,
        lone_wall,
    )
}


def rendered(
    name: str, seed: int, views: int, baseline: float = 0.0, poses: np.ndarray | None = None
) -> list[Frame]:
    """Return the frames of a scene.

    Args:
        name: Of `SCENES`.
        seed: Of dimensions, reflectivities, poses and paths.
        views: Number of frames.
        baseline: Of the light, metres to the right of the camera.
        poses: world_from_camera (views, 4, 4); None: those of the scene.
    """
    key = f"bounces 1 {name} {seed} {views} {baseline} {PATHS} {FREQUENCY}"
    if poses is not None:
        key += hashlib.sha256(poses.round(9).tobytes()).hexdigest()
    array = cached(key, lambda: _rendered(name, seed, views, baseline, poses))
    return [
        Frame(
            name=name,
            distance=one[0],
            amplitude=GAIN * one[1],
            ratio=one[2] + 1j * one[3],
            normal=np.moveaxis(one[4:7], 0, -1),
            shape=one[7].astype(int),
        )
        for one in array
    ]


def _rendered(
    name: str, seed: int, views: int, baseline: float, poses: np.ndarray | None
) -> np.ndarray:
    start_renderer()
    parts, usual = SCENES[name](np.random.default_rng([seed, *name.encode()]), views)
    poses = np.stack(usual) if poses is None else poses
    return np.stack([_frame(parts, pose, seed + i, baseline) for i, pose in enumerate(poses)])


def _frame(parts: dict[str, Part], pose: np.ndarray, seed: int, baseline: float) -> np.ndarray:
    """Return distance, direct amplitude, ratio (2), normal (3) and surface, (8, H, W)."""
    import drjit as dr
    import mitsuba as mi

    light = pose.copy()
    light[:3, 3] += baseline * pose[:3, 0]
    lamp = {
        "type": "spot",
        "to_world": mi.ScalarTransform4f(light.tolist()),
        "intensity": {"type": "rgb", "value": 1.0},
        "cutoff_angle": CONE,
        "beam_width": CONE - 2,
    }
    ahead = (rays() @ pose[:3, :3].T).reshape(-1, 3)
    count = len(ahead)
    origin = mi.Point3f(*map(float, pose[:3, 3]))

    def light_of(depth: int, paths: int) -> tuple[np.ndarray, Any]:
        follow = {"type": "transient_path", "max_depth": depth, "rr_depth": 20}
        scene: Any = mi.load_dict({"type": "scene", "integrator": follow, "lamp": lamp, **parts})
        index = dr.arange(mi.UInt32, count * paths) // paths
        beams = mi.Ray3f(origin, dr.gather(mi.Vector3f, mi.Vector3f(ahead.T), index))
        sums = [dr.zeros(mi.Float, count) for _ in range(2)]
        turn = 2 * np.pi * FREQUENCY / SPEED_OF_LIGHT

        def add(spec: Any, length: Any, _wavelengths: object, active: Any) -> None:  # noqa: ANN401
            strength, active = spec.x / paths, active & (spec.x > 0)  # Others have no length.
            for total, wave in zip(sums, (dr.cos, dr.sin), strict=True):
                dr.scatter_reduce(
                    dr.ReduceOp.Add, total, strength * wave(turn * length), index, active
                )

        dr.eval(traced(scene, beams, seed, add), *sums)
        return np.array(sums[0]) + 1j * np.array(sums[1]), scene

    direct, scene = light_of(2, 1)
    everything, _ = light_of(8, PATHS)
    hit = scene.ray_intersect(mi.Ray3f(origin, mi.Vector3f(ahead.T)))
    there = np.array(hit.is_valid()) & (abs(direct) > 0)
    distance = np.where(there, np.array(hit.t), np.nan)
    ratio = np.where(there, everything / np.where(there, direct, 1) - 1, np.nan)
    normal = np.array(hit.n).T @ pose[:3, :3]
    normal *= -np.sign((normal * rays().reshape(-1, 3)).sum(-1, keepdims=True))
    shape = np.array(dr.reinterpret_array(mi.UInt32, hit.shape))
    shape = np.where(there, np.unique(shape, return_inverse=True)[1].reshape(-1), -1)
    amplitude = np.where(there, abs(direct), np.nan)
    all_of_it = [distance, amplitude, np.real(ratio), np.imag(ratio), *normal.T, shape]
    return np.stack(all_of_it).reshape(8, HEIGHT, WIDTH)
