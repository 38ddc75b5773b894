"""Wrong recordings: what once passed with a confident number, as users make them, and unlisted."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from benchmarks.renewed.geometry import transforms
from benchmarks.wrong_recordings.parts import Parts, drawn_motion, drawn_rotation
from tofcorr.geometry.camera import CameraIntrinsics
from tofcorr.geometry.rays import ray_directions

Draw = np.random.Generator
Fault = Callable[[Parts, Draw], Parts]
"""Returns a wrong copy of a recording."""


def to(**formulas: Callable[[Parts, Draw], Any]) -> Fault:
    """Other parts, each by a formula of the right ones."""
    return lambda parts, g: parts.changed(**{name: of(parts, g) for name, of in formulas.items()})


def of_depth(change: Callable[[np.ndarray], np.ndarray]) -> Fault:
    """Depth images changed, shape (N, H, W)."""
    return to(depth=lambda parts, _: change(parts.depth))


def of_pixels(share: float, change: Callable[[np.ndarray, Draw], np.ndarray]) -> Fault:
    """The depth of a share of the pixels changed."""

    def depth(parts: Parts, generator: Draw) -> np.ndarray:
        chosen = generator.uniform(size=parts.depth.shape) < share
        return np.where(chosen, change(parts.depth, generator), parts.depth)

    return to(depth=depth)


def of_images(change: Callable[[np.ndarray], np.ndarray]) -> Fault:
    """Depth and amplitude images changed alike."""
    return to(
        depth=lambda parts, _: change(parts.depth),
        amplitude=lambda parts, _: None if parts.amplitude is None else change(parts.amplitude),
    )


def of_rotation(change: Callable[[Rotation], Rotation]) -> Fault:
    """Rotations of the poses changed."""
    return to(rotation=lambda p, _: change(Rotation.from_matrix(p.rotation)).as_matrix())


def of_place(change: Callable[[np.ndarray], Any]) -> Fault:
    """Translations of the poses changed, shape (N, 3)."""
    return to(place=lambda parts, _: change(parts.place))


def where(chosen: np.ndarray, new: np.ndarray, old: np.ndarray) -> np.ndarray:
    """New values in the chosen ones of N frames."""
    return np.where(chosen.reshape(-1, *[1] * (old.ndim - 1)), new, old)


def since(share: float) -> Callable[[int, Draw], np.ndarray]:
    """Which frames come after a share of all."""
    return lambda count, _: np.arange(count) >= int(share * count)


def some(chosen: Callable[[int, Draw], np.ndarray], fault: Fault) -> Fault:
    """Some frames as a fault makes them, the others as they were."""

    def fault_of_some(parts: Parts, generator: Draw) -> Parts:
        wrong = fault(parts, generator)
        which = chosen(len(parts.poses), generator)
        pairs = {k: (getattr(wrong, k), old) for k, old in vars(parts).items() if k != "header"}
        mixed = {k: where(which, *pair) for k, pair in pairs.items() if pair[1] is not None}
        return parts.changed(**mixed)

    return fault_of_some


def over_image(parts: Parts) -> tuple[np.ndarray, np.ndarray]:
    """Row and column of each pixel, from -0.5 to 0.5."""
    height, width = parts.depth.shape[1:]
    rows, columns = np.mgrid[:height, :width]
    return rows / height - 0.5, columns / width - 0.5


# The camera.


def of_camera(**formulas: Callable[[CameraIntrinsics, Draw], Any]) -> Fault:
    """The header has another camera."""

    def fault(parts: Parts, generator: Draw) -> Parts:
        camera = parts.header["camera"]
        new = {name: of(camera, generator) for name, of in formulas.items()}
        return parts.changed(camera=replace(camera, **new))

    return fault


def of_matrix(change: Callable[[np.ndarray, Draw], np.ndarray]) -> Fault:
    """The header has another camera matrix."""
    return of_camera(
        matrix=lambda one, g: tuple(map(tuple, change(np.array(one.matrix), g).tolist()))
    )


def either(factor: float, generator: Draw) -> float:
    """A factor, or one over it."""
    return factor if generator.uniform() < 0.5 else 1 / factor


def of_focal(*wrong: int) -> Fault:
    """Horizontal or vertical focal length, or both, off by a tenth."""
    return of_matrix(lambda k, g: np.where(np.diag([*wrong, 0]), either(1.1, g), 1.0) * k)


def tangential_last(camera: CameraIntrinsics, generator: Draw) -> tuple[float, ...]:
    """The coefficients of a strong lens in the order k1 k2 k3 p1 p2."""
    k1, k2, p1, p2, k3 = (*camera.distortion, 0.0, 0.0, 0.0, 0.0, 0.0)[:5]
    return k1, k2, k3 or generator.uniform(0.05, 0.15), p1, p2


def of_strong_lens(camera: CameraIntrinsics, generator: Draw) -> tuple[float, ...]:
    """The distortion of another lens: the images are rectified."""
    k1, k2, *others = camera.distortion or (0.0,) * 5
    return k1 - 0.25, k2 + 0.08, *others


def one_pixel(parts: Parts, generator: Draw) -> Parts:
    """Images of 1 x 1 pixels: the one at the principal point."""
    (fx, _, u), (_, fy, v), last = parts.header["camera"].matrix
    own = np.s_[:, round(v) : round(v) + 1, round(u) : round(u) + 1]
    matrix = ((fx, 0.0, u - round(u)), (0.0, fy, v - round(v)), last)
    camera = CameraIntrinsics(width=1, height=1, matrix=matrix, distortion=())
    return of_images(lambda images: images[own])(parts, generator).changed(camera=camera)


# Images.


def swapped_bytes(depth: np.ndarray) -> np.ndarray:
    """Bytes of 16-bit millimetres exchanged (big-endian read as little-endian)."""
    return np.round(1e3 * np.nan_to_num(depth)).astype(np.uint16).byteswap().astype(float) / 1e3


def wrapped_counts(depth: np.ndarray) -> np.ndarray:
    """Counts of 16 bits of 1/64 mm, which start at zero again beyond 1.024 m."""
    return np.round(64e3 * np.nan_to_num(depth)).astype(np.int64) % 65536 / 64e3


def copied_frames(depth: np.ndarray) -> np.ndarray:
    """The camera hung: a fifth of the frames repeats the one before."""
    number = np.arange(len(depth))
    return depth[number - (number % 5 == 1)]


def inverted_mask(parts: Parts, generator: Draw) -> Parts:
    """A wall behind the target, and a mask that shows the wall instead of the target."""
    outside = np.maximum(*map(np.abs, over_image(parts))) >= 0.3
    depth = parts.depth + generator.uniform(0.3, 0.8) * outside
    return parts.changed(depth=depth, mask=np.repeat(outside[None], len(depth), axis=0))


def another_camera(parts: Parts, generator: Draw) -> Parts:
    """Another camera of the same make: other offset, pattern, mount."""
    row, column = over_image(parts)
    tilted = generator.normal(0, 0.015)
    tilted = tilted + generator.normal(0, 0.010) * row + generator.normal(0, 0.010) * column
    error = tilted + generator.normal(0, 0.004, size=row.shape)
    turn = drawn_rotation(generator.uniform(0.5, 1.5), generator)
    mount = transforms(turn, generator.normal(0, 0.005, 3))
    return parts.changed(depth=parts.depth + error, poses=parts.poses @ mount)


def other_exposure(parts: Parts, generator: Draw) -> Parts:
    """Four times the exposure: other amplitude, other distance."""
    assert parts.amplitude is not None
    off = generator.choice([-1, 1]) * generator.uniform(0.02, 0.04)
    return parts.changed(depth=parts.depth + off, amplitude=4 * parts.amplitude)


# Walls and targets.


def planes_turned(low: float, high: float) -> Fault:
    """All planes turned by an angle in degrees about the origin of the world."""

    def normals(parts: Parts, generator: Draw) -> np.ndarray:
        # About an axis in the wall: a turn about its normal would leave the wall as it is.
        axis = np.cross(parts.normal[0], generator.normal(size=3))
        angle = np.radians(generator.uniform(low, high)) * axis / np.linalg.norm(axis)
        return parts.normal @ Rotation.from_rotvec(angle).as_matrix().T

    return to(normal=normals)


def swapped_walls(parts: Parts, generator: Draw) -> Parts:
    """A tenth of the frames shows another wall than the one recorded for it."""
    order = generator.permutation(len(parts.normal))
    chosen = np.isin(np.arange(len(order)), order[: max(len(order) // 10, 1)])
    turned = parts.normal @ drawn_rotation(60, generator).T
    normal = where(chosen, turned, parts.normal)
    return parts.changed(normal=normal, offset=parts.offset + 0.3 * chosen)


def another_target(parts: Parts, generator: Draw) -> Parts:
    """The wall stands 40 to 80 mm behind the recorded one, and is tilted by 1.5 degrees."""
    axis = np.cross(parts.normal[0], generator.normal(size=3))
    turned = parts.normal @ Rotation.from_rotvec(np.radians(1.5) * axis).as_matrix().T
    return parts.changed(normal=turned, offset=parts.offset + generator.uniform(0.04, 0.08))


def a_sphere(parts: Parts, generator: Draw) -> Parts:
    """The wall is no plane: it comes nearer by 100 mm with the square of a metre on it."""
    camera = parts.poses @ parts.header["tool_from_camera"]
    points = ray_directions(parts.header["camera"]).numpy() * parts.depth[..., None]
    world = np.einsum("fab,fhwb->fhwa", camera[:, :3, :3], points) + camera[:, None, None, :3, 3]
    middle = np.median(world.reshape(-1, 3), axis=0)
    return parts.changed(depth=parts.depth - 0.1 * np.linalg.norm(world - middle, axis=-1) ** 2)


def a_table_below(depth: np.ndarray) -> np.ndarray:
    """The lower fifth of every image shows a table in front of the wall, nowhere masked."""
    height = depth.shape[1]
    above = np.ones(height - height // 5)
    return depth * np.append(above, np.linspace(0.9, 0.5, height // 5))[:, None]


# Poses.


def mirrored(axis: int | None) -> Fault:
    """Poses as a left-handed program writes them: one axis of the world, or any, turned round."""

    def fault(parts: Parts, generator: Draw) -> Parts:
        sign = np.ones(3)
        sign[int(generator.integers(3)) if axis is None else axis] = -1
        rotation = parts.rotation * sign[:, None] * sign
        return parts.changed(rotation=rotation, place=parts.place * sign)

    return fault


def one_pose_off(parts: Parts, generator: Draw) -> np.ndarray:
    """One place is off by 100 mm, along the wall's normal: the way that shows."""
    k, place = int(generator.integers(len(parts.poses))), parts.place.copy()
    place[k] += 0.1 * parts.normal[k] * generator.choice([-1, 1])
    return place


def several_poses_off(parts: Parts, generator: Draw) -> np.ndarray:
    """Every eighth pose is off by 60 to 200 mm in some direction, and by some degrees."""
    poses = parts.poses.copy()
    for k in range(0, len(poses), 8):
        step = generator.normal(size=3)
        poses[k, :3, 3] += generator.uniform(0.06, 0.2) * step / np.linalg.norm(step)
        poses[k, :3, :3] = drawn_rotation(generator.uniform(3, 10), generator) @ poses[k, :3, :3]
    return poses


def drifting(parts: Parts, generator: Draw) -> np.ndarray:
    """Odometry instead of an arm: the place drifts by 200 mm over the recording."""
    away = generator.normal(size=3)
    away /= np.linalg.norm(away)
    return parts.place + np.linspace(0, 0.2, len(parts.poses))[:, None] * away


def homed_anew(parts: Parts, generator: Draw) -> np.ndarray:
    """Poses of another world: the robot was re-homed."""
    turn = drawn_rotation(10, generator)
    return transforms(turn, generator.normal(0, 0.1, 3)) @ parts.poses


def varying_lag(parts: Parts, generator: Draw) -> np.ndarray:
    """Every pose was read too late, by up to a twentieth of the way to the next."""
    poses = parts.poses.copy()
    for k in range(len(poses) - 1):
        share = generator.uniform(0, 0.05)
        between = Slerp([0, 1], Rotation.from_matrix(poses[k : k + 2, :3, :3]))
        poses[k, :3, :3] = between(share).as_matrix()
        poses[k, :3, 3] += share * (poses[k + 1, :3, 3] - poses[k, :3, 3])
    return poses


def other_tool(metres: float, degrees: float) -> Fault:
    """Poses of another tool frame, or of a camera that was knocked."""
    return to(poses=lambda parts, g: parts.poses @ drawn_motion(metres, degrees, g))


def only(chosen: Callable[[int, Draw], np.ndarray]) -> Fault:
    """Some frames, in an order."""
    return lambda parts, g: parts.frames(chosen(len(parts.poses), g))


TABLE: dict[str, Fault] = {
    "planes 37-50 deg off": planes_turned(37, 50),
    "planes 40 deg off": planes_turned(40, 40),
    "planes 5 deg off": planes_turned(5, 5),
    "all poses the same": to(poses=lambda p, g: p.poses[[0] * len(p.poses)]),
    "all poses the identity": to(poses=lambda p, g: 0 * p.poses + np.eye(4)),
    "depth in millimetres": of_depth(lambda depth: 1e3 * depth),
    "poses in millimetres": of_place(lambda place: 1e3 * place),
    "radial given as z": to(
        depth_kind=lambda p, g: {"radial": "z", "z": "radial"}[p.header["depth_kind"]]
    ),
    "z given as radial": to(
        depth=lambda p, g: p.depth * ray_directions(p.header["camera"]).numpy()[..., 2]
    ),
    "normals flipped": to(normal=lambda p, g: -p.normal, offset=lambda p, g: -p.offset),
    "3 % of the pixels 0.7 m off": of_pixels(0.03, lambda depth, g: depth + 0.7),
    "30 % garbage pixels": of_pixels(0.3, lambda depth, g: g.uniform(0.2, 4.0, depth.shape)),
    "quaternions as wxyz": of_rotation(lambda r: Rotation.from_quat(r.as_quat()[:, [3, 0, 1, 2]])),
    "poses inverted": to(poses=lambda p, g: np.linalg.inv(p.poses)),
    "left-handed world": mirrored(None),
    "rows shifted by one": lambda p, g: p.frames(slice(0, -1)).changed(poses=p.poses[1:]),
    "mask inverted": inverted_mask,
    "two cameras mixed": some(since(1 / 2), another_camera),
    "focal length 10 % off": of_focal(1, 1),
    "one pose 100 mm off": to(place=one_pose_off),
    "five frames": only(lambda count, g: np.sort(g.permutation(count)[:5])),
    "depth stuck at 1 m": of_depth(np.ones_like),
    "1 x 1 pixels": one_pixel,
}
"""What once passed with a confident number."""

FURTHER: dict[str, Fault] = {
    "images mirrored": of_images(lambda images: images[:, :, ::-1]),
    "images upside down": of_images(lambda images: images[:, ::-1]),
    "K of half the resolution": of_matrix(lambda k, g: np.diag([0.5, 0.5, 1.0]) @ k),
    "principal point of a crop": lambda p, g: of_matrix(
        lambda k, g: k + np.outer([0.25 * p.depth.shape[2], 0, 0], [0, 0, 1])
    )(p, g),
    "depth in centimetres": of_depth(lambda depth: 1e2 * depth),
    "depth in inches": of_depth(lambda depth: depth / 0.0254),
    "depth in feet": of_depth(lambda depth: depth / 0.3048),
    "depth divided by 1000 twice": of_depth(lambda depth: 1e-3 * depth),
    "depth wrapped at 1 m": of_depth(lambda depth: np.mod(depth, 1.0)),
    "depth with exchanged bytes": of_depth(swapped_bytes),
    "depth and amplitude exchanged": to(
        depth=lambda p, g: p.amplitude, amplitude=lambda p, g: np.nan_to_num(p.depth)
    ),
    "depth is noise": to(depth=lambda p, g: g.uniform(0.3, 3.0, p.depth.shape)),
    "depth rounded to 50 mm": of_depth(lambda depth: np.round(depth / 0.05) * 0.05),
    "depth clipped": of_depth(lambda depth: np.minimum(depth, np.nanquantile(depth, 0.7))),
    "camera hung for a fifth": of_depth(copied_frames),
    "camera hung for good": of_depth(lambda depth: np.repeat(depth[:1], len(depth), axis=0)),
    "poses sorted as text": to(
        poses=lambda p, g: p.poses[np.argsort([str(k) for k in range(len(p.poses))])]
    ),
    "all rows shuffled": only(lambda count, g: g.permutation(count)),
    "a tenth of another wall": swapped_walls,
    "poses with one decimal": of_place(lambda place: np.round(place, 1)),
    "rotations in degrees": of_rotation(lambda r: Rotation.from_rotvec(np.degrees(r.as_rotvec()))),
    "angles in another order": of_rotation(lambda r: Rotation.from_euler("XYZ", r.as_euler("xyz"))),
    "poses that drift 200 mm": to(place=drifting),
    "planes of another origin": of_place(lambda place: np.add(place, [0.4, -0.3, 0.5])),
    "poses without translations": of_place(lambda place: 0.0),
    "poses without rotations": to(rotation=lambda p, g: np.eye(3)),
    "poses in centimetres": of_place(lambda place: 1e2 * place),
    "poses in inches": of_place(lambda place: place / 0.0254),
    "poses of a mirrored y axis": mirrored(1),
    "a curved target": a_sphere,
    "a table in the image": of_depth(a_table_below),
    "every eighth pose off": to(poses=several_poses_off),
    "amplitude of one value": to(amplitude=lambda p, g: np.full(p.depth.shape, 100.0)),
    "robot homed anew half way": some(since(1 / 2), to(poses=homed_anew)),
}
"""Kinds of wrong input as users make them."""

UNLISTED: dict[str, Fault] = {
    # The robot's base was moved between them, by 60 mm and 4 degrees.
    "two worlds joined": some(
        lambda count, g: np.arange(count) >= g.integers(count // 4, 3 * count // 4),
        to(poses=lambda p, g: drawn_motion(0.06, 4, g) @ p.poses),
    ),
    "poses too late by a varying lag": to(poses=varying_lag),
    "distortion as k1 k2 k3 p1 p2": of_camera(distortion=tangential_last),
    "distortion left out": of_camera(distortion=lambda camera, g: ()),
    "distortion of rectified images": of_camera(distortion=of_strong_lens),
    "principal point exchanged": of_matrix(lambda k, g: np.c_[k[:, :2], k[[1, 0, 2], 2]]),
    "one focal length 10 % off": of_focal(1, 0),
    "counts of 16 bits that wrap": of_depth(wrapped_counts),
    "every second frame of another exposure": some(
        lambda count, _: np.arange(count) % 2 == 0, other_exposure
    ),
    "frames averaged in time": of_depth(
        lambda depth: np.concatenate([depth[:1], 0.9 * depth[1:] + 0.1 * depth[:-1]])
    ),
    # The board comes nearer, as if the camera stood nearer to the wall.
    "a board 30 mm before the wall": to(
        place=lambda p, g: p.place + 0.03 * p.normal * (p.target == p.target[-1])[:, None]
    ),
    "amplitude one frame late": to(amplitude=lambda p, g: np.roll(np.array(p.amplitude), 1, 0)),
    "images rolled by two columns": of_images(lambda images: np.roll(images, 2, axis=2)),
    "half of the poses of another flange": some(
        lambda count, g: g.uniform(size=count) < 0.5, other_tool(0.02, 2)
    ),
    "a robot 4 % too long": to(place=lambda p, g: either(1.04, g) * p.place),
    "holes filled from the frame before": of_pixels(0.1, lambda depth, g: np.roll(depth, 1, 0)),
    "a wall 60 mm behind": another_target,
    # The wall stands a metre from the origin of the world, and d has the sign of n . x = d.
    "planes as n . x = d": to(
        place=lambda p, g: p.place + p.normal, offset=lambda p, g: 1.0 - p.offset
    ),
    "poses of the camera before it was remounted": some(since(3 / 4), other_tool(0.008, 1)),
    "depth of every pixel's median over the frames": of_depth(
        lambda depth: 0.95 * depth + 0.05 * np.nanmedian(depth, axis=0)
    ),
}
"""Thought of after the checks were written."""
