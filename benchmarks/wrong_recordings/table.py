"""Wrong recordings: what once passed with a confident number, as users make them, and unlisted."""

from collections.abc import Callable, Mapping
from copy import deepcopy
from dataclasses import replace
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from benchmarks.wrong_recordings.parts import Parts, drawn_motion, drawn_rotation
from tofcorr.geometry.rays import ray_directions

Draw = np.random.Generator
Fault = Callable[[Parts, Draw], Parts]
"""Returns a wrong copy of a recording."""
Change = Callable[[Parts, Draw], None]
"""Makes the recording wrong that it is given."""


def faults(changes: Mapping[str, Change]) -> dict[str, Fault]:
    """Return what makes wrong copies, by the same names."""

    def fault_of(change: Change) -> Fault:
        def fault(parts: Parts, generator: Draw) -> Parts:
            copy = deepcopy(parts)
            change(copy, generator)
            return copy

        return fault

    return {name: fault_of(change) for name, change in changes.items()}


def to(**formulas: Callable[[Parts, Draw], Any]) -> Change:
    """Other parts, each by a formula of the right ones."""

    def change(parts: Parts, generator: Draw) -> None:
        for name, value in {name: of(parts, generator) for name, of in formulas.items()}.items():
            setattr(parts, name, value)

    return change


def of_depth(change: Callable[[np.ndarray], np.ndarray]) -> Change:
    """Depth images changed, shape (N, H, W)."""
    return to(depth=lambda parts, _: change(parts.depth))


def of_images(change: Callable[[np.ndarray], np.ndarray]) -> Change:
    """Depth and amplitude images changed alike."""
    return to(
        depth=lambda parts, _: change(parts.depth),
        amplitude=lambda parts, _: None if parts.amplitude is None else change(parts.amplitude),
    )


# The camera.


def change_camera(parts: Parts, **changes: object) -> None:
    """Give the recording another camera in its header."""
    parts.header["camera"] = replace(parts.header["camera"], **changes)


def change_lens(parts: Parts, fx: float = 1.0, fy: float = 1.0, u: float = 0, v: float = 0) -> None:
    """Multiply focal lengths, and shift the principal point by pixels."""
    matrix = np.array(parts.header["camera"].matrix)
    matrix[[0, 1], [0, 1]] *= fx, fy
    matrix[:2, 2] += u, v
    change_camera(parts, matrix=tuple(map(tuple, matrix.tolist())))


def centre_exchanged(parts: Parts, generator: Draw) -> None:
    """The principal point is written as row and column."""
    (_, _, u), (_, _, v), _ = parts.header["camera"].matrix
    change_lens(parts, u=v - u, v=u - v)


def wider_pixels(parts: Parts, generator: Draw) -> None:
    """Rows were binned and columns were not: one focal length is 10 % off."""
    change_lens(parts, 1.1 if generator.uniform() < 0.5 else 1 / 1.1)


def focal_length(factor: float) -> Change:
    """The focal length of the header is off by a factor."""

    def change(parts: Parts, generator: Draw) -> None:
        off = factor if generator.uniform() < 0.5 else 1 / factor
        change_lens(parts, off, off)

    return change


def half_resolution(parts: Parts, generator: Draw) -> None:
    """K belongs to images of half the size."""
    matrix = np.diag([0.5, 0.5, 1.0]) @ parts.header["camera"].matrix
    change_camera(parts, matrix=tuple(map(tuple, matrix.tolist())))


def tangential_last(parts: Parts, generator: Draw) -> None:
    """A strong lens whose coefficients are in the order k1 k2 k3 p1 p2."""
    k1, k2, p1, p2, k3 = (*parts.header["camera"].distortion, 0.0, 0.0, 0.0, 0.0, 0.0)[:5]
    k3 = k3 or generator.uniform(0.05, 0.15)
    change_camera(parts, distortion=(k1, k2, k3, p1, p2))


def distorted_twice(parts: Parts, generator: Draw) -> None:
    """The images are rectified, and the header has the lens's distortion, here a strong one."""
    k1, k2, *others = parts.header["camera"].distortion or (0.0,) * 5
    change_camera(parts, distortion=(k1 - 0.25, k2 + 0.08, *others))


def one_pixel(parts: Parts, generator: Draw) -> None:
    """Images of 1 x 1 pixels: the one at the principal point."""
    (_, _, u), (_, _, v), _ = parts.header["camera"].matrix
    change_lens(parts, u=-round(u), v=-round(v))
    change_camera(parts, width=1, height=1, distortion=())
    own = np.s_[:, round(v) : round(v) + 1, round(u) : round(u) + 1]
    of_images(lambda images: images[own])(parts, generator)


# Images.


def swapped_bytes(depth: np.ndarray) -> np.ndarray:
    """Bytes of 16-bit millimetres exchanged (big-endian read as little-endian)."""
    return np.round(1e3 * np.nan_to_num(depth)).astype(np.uint16).byteswap().astype(float) / 1e3


def wrapped_counts(depth: np.ndarray) -> np.ndarray:
    """Counts of 16 bits of 1/64 mm, which start at zero again beyond 1.024 m."""
    return np.round(64e3 * np.nan_to_num(depth)).astype(np.int64) % 65536 / 64e3


def other_kind(parts: Parts, generator: Draw) -> None:
    """Depth of one kind declared as the other."""
    parts.header["depth_kind"] = {"radial": "z", "z": "radial"}[parts.header["depth_kind"]]


def z_as_radial(parts: Parts, generator: Draw) -> None:
    """Depth along the axis, declared as along the ray."""
    parts.depth *= ray_directions(parts.header["camera"]).numpy()[..., 2]


def garbage(share: float, away: float) -> Change:
    """A share of the pixels off by a distance in metres, nowhere masked."""
    return to(depth=lambda p, g: p.depth + away * (g.uniform(size=p.depth.shape) < share))


def random_garbage(share: float) -> Change:
    """A share of the pixels with a distance drawn anywhere in the range."""

    def change(parts: Parts, generator: Draw) -> None:
        hit = generator.uniform(size=parts.depth.shape) < share
        drawn = generator.uniform(0.2, 4.0, size=parts.depth.shape)
        parts.depth = np.where(hit, drawn, parts.depth)

    return change


def filled_holes(parts: Parts, generator: Draw) -> None:
    """A driver fills every tenth pixel with its last value: that of the frame before."""
    hit = generator.uniform(size=parts.depth.shape) < 0.1
    parts.depth = np.where(hit, np.roll(parts.depth, 1, axis=0), parts.depth)


def averaged_in_time(parts: Parts, generator: Draw) -> None:
    """The camera averages successive frames: a tenth of each image is the one before."""
    parts.depth[1:] = 0.9 * parts.depth[1:] + 0.1 * parts.depth[:-1]


def copied_frames(parts: Parts, generator: Draw) -> None:
    """The camera hung: a fifth of the frames repeats the one before."""
    later = np.arange(1, len(parts.depth), 5)
    parts.depth[later] = parts.depth[later - 1]


def inverted_mask(parts: Parts, generator: Draw) -> None:
    """A wall behind the target, and a mask that shows the wall instead of the target."""
    height, width = parts.depth.shape[1:]
    rows, columns = np.mgrid[:height, :width]
    outside = np.maximum(np.abs(rows / height - 0.5), np.abs(columns / width - 0.5)) >= 0.3
    parts.depth += generator.uniform(0.3, 0.8) * outside
    parts.mask = np.repeat(outside[None], len(parts.depth), axis=0)


def two_cameras(parts: Parts, generator: Draw) -> None:
    """The second half comes from another camera of the same make: other offset, pattern, mount."""
    height, width = parts.depth.shape[1:]
    half = len(parts.depth) // 2
    rows, columns = np.mgrid[:height, :width]
    parts.depth[half:] += (
        generator.normal(0, 0.015)
        + generator.normal(0, 0.010) * (rows / height - 0.5)
        + generator.normal(0, 0.010) * (columns / width - 0.5)
        + generator.normal(0, 0.004, size=(height, width))
    )
    mount = np.eye(4)
    mount[:3, :3] = drawn_rotation(generator.uniform(0.5, 1.5), generator)
    mount[:3, 3] = generator.normal(0, 0.005, 3)
    parts.poses[half:] = parts.poses[half:] @ mount


def other_exposure(parts: Parts, generator: Draw) -> None:
    """Every second frame has four times the exposure: other amplitude, other distance."""
    assert parts.amplitude is not None
    parts.depth[::2] += generator.choice([-1, 1]) * generator.uniform(0.02, 0.04)
    parts.amplitude[::2] *= 4


# Walls and targets.


def planes_turned(low: float, high: float) -> Change:
    """All planes turned by an angle in degrees about the origin of the world."""

    def change(parts: Parts, generator: Draw) -> None:
        # About an axis in the wall: a turn about its normal would leave the wall as it is.
        axis = np.cross(parts.normal[0], generator.normal(size=3))
        angle = np.radians(generator.uniform(low, high)) * axis / np.linalg.norm(axis)
        parts.normal = parts.normal @ Rotation.from_rotvec(angle).as_matrix().T

    return change


def swapped_walls(parts: Parts, generator: Draw) -> None:
    """A tenth of the frames shows another wall than the one recorded for it."""
    chosen = generator.permutation(len(parts.normal))[: max(len(parts.normal) // 10, 1)]
    parts.normal[chosen] = parts.normal[chosen] @ drawn_rotation(60, generator).T
    parts.offset[chosen] += 0.3


def another_target(parts: Parts, generator: Draw) -> None:
    """The wall stands 40 to 80 mm behind the recorded one, and is tilted by 1.5 degrees."""
    axis = np.cross(parts.normal[0], generator.normal(size=3))
    parts.normal = parts.normal @ Rotation.from_rotvec(np.radians(1.5) * axis).as_matrix().T
    parts.offset += generator.uniform(0.04, 0.08)


def other_sign(parts: Parts, generator: Draw) -> None:
    """The wall stands a metre from the origin of the world, and d has the sign of n . x = d."""
    parts.place[:] += parts.normal
    parts.offset = 1.0 - parts.offset


def thick_board(parts: Parts, generator: Draw) -> None:
    """The board stands 30 mm before the wall, and has the wall's plane."""
    board = parts.target == parts.target[-1]
    # The board comes nearer, as if the camera stood nearer to the wall.
    parts.place[board] += 0.03 * parts.normal[board]


def a_sphere(parts: Parts, generator: Draw) -> None:
    """The wall is no plane: it comes nearer by 100 mm with the square of a metre on it."""
    camera = parts.poses @ parts.header["tool_from_camera"]
    points = ray_directions(parts.header["camera"]).numpy() * parts.depth[..., None]
    world = np.einsum("fab,fhwb->fhwa", camera[:, :3, :3], points) + camera[:, None, None, :3, 3]
    middle = np.median(world.reshape(-1, 3), axis=0)
    parts.depth -= 0.1 * np.linalg.norm(world - middle, axis=-1) ** 2


def a_table_below(parts: Parts, generator: Draw) -> None:
    """The lower fifth of every image shows a table in front of the wall, nowhere masked."""
    rows = parts.depth.shape[1] // 5
    parts.depth[:, -rows:] *= np.linspace(0.9, 0.5, rows)[:, None]


# Poses.


def of_poses(rotation: np.ndarray | None, factor: float = 1.0) -> Change:
    """Poses with one rotation for all, and places times a factor."""

    def change(parts: Parts, generator: Draw) -> None:
        parts.place[:] *= factor
        if rotation is not None:
            parts.rotation[:] = rotation

    return change


def wxyz(parts: Parts, generator: Draw) -> None:
    """Quaternions whose scalar is taken for the first of the vector."""
    quaternions = Rotation.from_matrix(parts.rotation).as_quat()[:, [3, 0, 1, 2]]
    parts.rotation[:] = Rotation.from_quat(quaternions).as_matrix()


def mirrored(axis: int | None) -> Change:
    """Poses as a left-handed program writes them: one axis of the world, or any, turned round."""

    def change(parts: Parts, generator: Draw) -> None:
        sign = np.ones(3)
        sign[int(generator.integers(3)) if axis is None else axis] = -1
        parts.rotation[:] *= sign[:, None] * sign
        parts.place[:] *= sign

    return change


def shifted(parts: Parts, generator: Draw) -> None:
    """One pose was dropped at the beginning: every row carries its neighbour's."""
    vars(parts).update(vars(parts.frames(slice(0, -1)).changed(poses=parts.poses[1:])))


def one_pose_off(metres: float) -> Change:
    """One pose is off by a distance, along the wall's normal: the way that shows."""

    def change(parts: Parts, generator: Draw) -> None:
        k = int(generator.integers(len(parts.poses)))
        parts.place[k] += metres * parts.normal[k] * generator.choice([-1, 1])

    return change


def several_poses_off(parts: Parts, generator: Draw) -> None:
    """Every eighth pose is off by 60 to 200 mm in some direction, and by some degrees."""
    for k in range(0, len(parts.poses), 8):
        step = generator.normal(size=3)
        parts.place[k] += generator.uniform(0.06, 0.2) * step / np.linalg.norm(step)
        turn = drawn_rotation(generator.uniform(3, 10), generator)
        parts.rotation[k] = turn @ parts.rotation[k]


def sorted_as_text(parts: Parts, generator: Draw) -> None:
    """Images sorted by name, 1, 10, 11, 2: poses and images are mixed up."""
    parts.poses = parts.poses[np.argsort([str(k) for k in range(len(parts.poses))])]


def degrees_for_radians(parts: Parts, generator: Draw) -> None:
    """Rotation vectors in degrees, read as radians."""
    vectors = np.degrees(Rotation.from_matrix(parts.rotation).as_rotvec())
    parts.rotation[:] = Rotation.from_rotvec(vectors).as_matrix()


def other_euler_order(parts: Parts, generator: Draw) -> None:
    """Roll, pitch and yaw read as if they belonged to the other axes."""
    angles = Rotation.from_matrix(parts.rotation).as_euler("xyz")
    parts.rotation[:] = Rotation.from_euler("XYZ", angles).as_matrix()


def drifting_poses(parts: Parts, generator: Draw) -> None:
    """Odometry instead of an arm: the place drifts by 200 mm over the recording."""
    away = generator.normal(size=3)
    away /= np.linalg.norm(away)
    parts.place[:] += np.linspace(0, 0.2, len(parts.poses))[:, None] * away


def offset_lost(parts: Parts, generator: Draw) -> None:
    """Every plane goes through the origin of a world that lies elsewhere."""
    parts.place[:] += [0.4, -0.3, 0.5]


def one_decimal(parts: Parts, generator: Draw) -> None:
    """Poses written with one decimal: 100 mm."""
    parts.place[:] = np.round(parts.place, 1)


def homed_anew(parts: Parts, generator: Draw) -> None:
    """The second half of the poses is of another world: the robot was re-homed."""
    turn = np.eye(4)
    turn[:3, :3] = drawn_rotation(10, generator)
    turn[:3, 3] = generator.normal(0, 0.1, 3)
    half = len(parts.poses) // 2
    parts.poses[half:] = turn @ parts.poses[half:]


def two_worlds(parts: Parts, generator: Draw) -> None:
    """Two recordings joined, the robot's base moved by 60 mm and 4 degrees between them."""
    moved, count = drawn_motion(0.06, 4, generator), len(parts.poses)
    cut = int(generator.integers(count // 4, 3 * count // 4))
    parts.poses[cut:] = moved @ parts.poses[cut:]


def varying_lag(parts: Parts, generator: Draw) -> None:
    """Every pose was read too late, by up to a twentieth of the way to the next."""
    for k in range(len(parts.poses) - 1):
        share = generator.uniform(0, 0.05)
        between = Slerp([0, 1], Rotation.from_matrix(parts.rotation[k : k + 2]))
        parts.rotation[k] = between(share).as_matrix()
        parts.place[k] += share * (parts.place[k + 1] - parts.place[k])


def other_flange(parts: Parts, generator: Draw) -> None:
    """Half of the frames, at random, have the pose of another tool frame: 20 mm and 2 degrees."""
    tool = drawn_motion(0.02, 2, generator)
    chosen = generator.uniform(size=len(parts.poses)) < 0.5
    parts.poses[chosen] = parts.poses[chosen] @ tool


def scaled_robot(parts: Parts, generator: Draw) -> None:
    """The robot's lengths are 4 % off."""
    parts.place[:] *= 1.04 if generator.uniform() < 0.5 else 1 / 1.04


def remounted(parts: Parts, generator: Draw) -> None:
    """The last quarter was recorded after the camera was knocked: 8 mm and 1 degree."""
    cut = 3 * len(parts.poses) // 4
    parts.poses[cut:] = parts.poses[cut:] @ drawn_motion(0.008, 1, generator)


def only(chosen: Callable[[int, Draw], np.ndarray]) -> Change:
    """Some frames, in an order."""
    return lambda parts, g: vars(parts).update(vars(parts.frames(chosen(len(parts.poses), g))))


TABLE = faults(
    {
        "planes 37-50 deg off": planes_turned(37, 50),
        "planes 40 deg off": planes_turned(40, 40),
        "planes 5 deg off": planes_turned(5, 5),
        "all poses the same": to(poses=lambda p, g: p.poses[[0] * len(p.poses)]),
        "all poses the identity": of_poses(np.eye(3), 0.0),
        "depth in millimetres": of_depth(lambda depth: 1e3 * depth),
        "poses in millimetres": of_poses(None, 1e3),
        "radial given as z": other_kind,
        "z given as radial": z_as_radial,
        "normals flipped": to(normal=lambda p, g: -p.normal, offset=lambda p, g: -p.offset),
        "3 % of the pixels 0.7 m off": garbage(0.03, 0.7),
        "30 % garbage pixels": random_garbage(0.3),
        "quaternions as wxyz": wxyz,
        "poses inverted": to(poses=lambda p, g: np.linalg.inv(p.poses)),
        "left-handed world": mirrored(None),
        "rows shifted by one": shifted,
        "mask inverted": inverted_mask,
        "two cameras mixed": two_cameras,
        "focal length 10 % off": focal_length(1.1),
        "one pose 100 mm off": one_pose_off(0.1),
        "five frames": only(lambda count, g: np.sort(g.permutation(count)[:5])),
        "depth stuck at 1 m": of_depth(np.ones_like),
        "1 x 1 pixels": one_pixel,
    }
)
"""What once passed with a confident number."""

FURTHER = faults(
    {
        "images mirrored": of_images(lambda images: images[:, :, ::-1]),
        "images upside down": of_images(lambda images: images[:, ::-1]),
        "K of half the resolution": half_resolution,
        "principal point of a crop": lambda p, g: change_lens(p, u=0.25 * p.depth.shape[2]),
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
        "camera hung for a fifth": copied_frames,
        "camera hung for good": of_depth(lambda depth: np.repeat(depth[:1], len(depth), axis=0)),
        "poses sorted as text": sorted_as_text,
        "all rows shuffled": only(lambda count, g: g.permutation(count)),
        "a tenth of another wall": swapped_walls,
        "poses with one decimal": one_decimal,
        "rotations in degrees": degrees_for_radians,
        "angles in another order": other_euler_order,
        "poses that drift 200 mm": drifting_poses,
        "planes of another origin": offset_lost,
        "poses without translations": of_poses(None, 0.0),
        "poses without rotations": of_poses(np.eye(3)),
        "poses in centimetres": of_poses(None, 1e2),
        "poses in inches": of_poses(None, 1 / 0.0254),
        "poses of a mirrored y axis": mirrored(1),
        "a curved target": a_sphere,
        "a table in the image": a_table_below,
        "every eighth pose off": several_poses_off,
        "amplitude of one value": to(amplitude=lambda p, g: np.full(p.depth.shape, 100.0)),
        "robot homed anew half way": homed_anew,
    }
)
"""Kinds of wrong input as users make them."""

UNLISTED = faults(
    {
        "two worlds joined": two_worlds,
        "poses too late by a varying lag": varying_lag,
        "distortion as k1 k2 k3 p1 p2": tangential_last,
        "distortion left out": lambda p, g: change_camera(p, distortion=()),
        "distortion of rectified images": distorted_twice,
        "principal point exchanged": centre_exchanged,
        "one focal length 10 % off": wider_pixels,
        "counts of 16 bits that wrap": of_depth(wrapped_counts),
        "every second frame of another exposure": other_exposure,
        "frames averaged in time": averaged_in_time,
        "a board 30 mm before the wall": thick_board,
        "amplitude one frame late": to(
            amplitude=lambda p, g: np.roll(np.asarray(p.amplitude), 1, axis=0)
        ),
        "images rolled by two columns": of_images(lambda images: np.roll(images, 2, axis=2)),
        "half of the poses of another flange": other_flange,
        "a robot 4 % too long": scaled_robot,
        "holes filled from the frame before": filled_holes,
        "a wall 60 mm behind": another_target,
        "planes as n . x = d": other_sign,
        "poses of the camera before it was remounted": remounted,
        "depth of every pixel's median over the frames": of_depth(
            lambda depth: 0.95 * depth + 0.05 * np.nanmedian(depth, axis=0)
        ),
    }
)
"""Thought of after the checks were written."""
