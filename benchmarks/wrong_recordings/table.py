"""Wrong recordings: what once passed with a confident number, as users make them, and unlisted."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from benchmarks.wrong_recordings.parts import (
    Parts,
    drawn_motion,
    drawn_rotation,
    mirrored,
    scaled,
    with_quaternions,
)
from tofcorr.geometry.camera import CameraIntrinsics
from tofcorr.geometry.rays import ray_directions

Fault = Callable[[Parts, np.random.Generator], Parts]
Pair = tuple[float, float]


def of_depth(change: Callable[[np.ndarray], np.ndarray]) -> Fault:
    """Depth images changed, shape (N, H, W)."""
    return lambda parts, generator: parts.changed(depth=change(parts.depth))


def of_images(change: Callable[[np.ndarray], np.ndarray]) -> Fault:
    """Depth and amplitude images changed alike."""
    return lambda parts, generator: parts.changed(
        depth=change(parts.depth),
        amplitude=None if parts.amplitude is None else change(parts.amplitude),
    )


def camera_with(parts: Parts, **changes: object) -> Parts:
    """Return the recording with another camera in its header."""
    return parts.with_header(camera=replace(parts.header["camera"], **changes))


def with_lens(parts: Parts, fx: float = 1.0, fy: float = 1.0, shift: Pair = (0.0, 0.0)) -> Parts:
    """Return the recording with focal lengths times factors and another principal point."""
    matrix = np.diag([fx, fy, 1.0]) * np.array(parts.header["camera"].matrix)
    matrix[:2, 2] = np.array(parts.header["camera"].matrix)[:2, 2] + shift
    return camera_with(parts, matrix=tuple(map(tuple, matrix.tolist())))


def centre_exchanged(parts: Parts, generator: np.random.Generator) -> Parts:
    """The principal point is written as row and column."""
    (_, _, u), (_, _, v), _ = parts.header["camera"].matrix
    return with_lens(parts, shift=(v - u, u - v))


def wider_pixels(parts: Parts, generator: np.random.Generator) -> Parts:
    """Rows were binned and columns were not: one focal length is 10 % off."""
    return with_lens(parts, 1.1 if generator.uniform() < 0.5 else 1 / 1.1)


def focal_length(factor: float) -> Fault:
    """The focal length of the header is off by a factor."""

    def fault(parts: Parts, generator: np.random.Generator) -> Parts:
        factors = factor if generator.uniform() < 0.5 else 1 / factor
        return with_lens(parts, factors, factors)

    return fault


def of_poses(rotation: np.ndarray | None, place: float = 1.0) -> Fault:
    """Poses with one rotation for all, and places times a factor."""

    def fault(parts: Parts, generator: np.random.Generator) -> Parts:
        poses = scaled(parts.poses, place)
        poses[:, :3, :3] = parts.poses[:, :3, :3] if rotation is None else rotation
        return parts.changed(poses=poses)

    return fault


def swapped_bytes(depth: np.ndarray) -> np.ndarray:
    """Bytes of 16-bit millimetres exchanged (big-endian read as little-endian)."""
    return np.round(1e3 * np.nan_to_num(depth)).astype(np.uint16).byteswap().astype(float) / 1e3


def planes_turned(low: float, high: float) -> Fault:
    """All planes turned by an angle in degrees about the origin of the world."""

    def fault(parts: Parts, generator: np.random.Generator) -> Parts:
        # About an axis in the wall: a turn about its normal would leave the wall as it is.
        normal = parts.normal[0]
        axis = np.cross(normal, generator.normal(size=3))
        angle = np.radians(generator.uniform(low, high)) * axis / np.linalg.norm(axis)
        turn = Rotation.from_rotvec(angle).as_matrix()
        return parts.changed(normal=parts.normal @ turn.T)

    return fault


def other_kind(parts: Parts, generator: np.random.Generator) -> Parts:
    """Depth of one kind declared as the other."""
    kind = {"radial": "z", "z": "radial"}[parts.header["depth_kind"]]
    return parts.with_header(depth_kind=kind)


def z_as_radial(parts: Parts, generator: np.random.Generator) -> Parts:
    """Depth along the axis, declared as along the ray."""
    cosine = ray_directions(parts.header["camera"]).numpy()[..., 2]
    return parts.changed(depth=parts.depth * cosine)


def garbage(share: float, away: float) -> Fault:
    """A share of the pixels off by a distance in metres, nowhere masked."""

    def fault(parts: Parts, generator: np.random.Generator) -> Parts:
        hit = generator.uniform(size=parts.depth.shape) < share
        return parts.changed(depth=parts.depth + np.where(hit, away, 0.0))

    return fault


def random_garbage(share: float) -> Fault:
    """A share of the pixels with a distance drawn anywhere in the range."""

    def fault(parts: Parts, generator: np.random.Generator) -> Parts:
        hit = generator.uniform(size=parts.depth.shape) < share
        drawn = generator.uniform(0.2, 4.0, size=parts.depth.shape)
        return parts.changed(depth=np.where(hit, drawn, parts.depth))

    return fault


def shifted(parts: Parts, generator: np.random.Generator) -> Parts:
    """One pose was dropped at the beginning: every row carries its neighbour's."""
    return parts.frames(slice(0, -1)).changed(poses=parts.poses[1:])


def inverted_mask(parts: Parts, generator: np.random.Generator) -> Parts:
    """A wall behind the target, and a mask that shows the wall instead of the target."""
    height, width = parts.depth.shape[1:]
    rows, columns = np.mgrid[:height, :width]
    from_middle = np.maximum(np.abs(rows / height - 0.5), np.abs(columns / width - 0.5))
    inside = from_middle < 0.3
    behind = generator.uniform(0.3, 0.8)
    depth = np.where(inside, parts.depth, parts.depth + behind)
    mask = np.repeat((~inside)[None], len(depth), axis=0)
    return parts.changed(depth=depth, mask=mask)


def two_cameras(parts: Parts, generator: np.random.Generator) -> Parts:
    """The second half comes from another camera of the same make: other offset, pattern, mount."""
    height, width = parts.depth.shape[1:]
    half = len(parts.depth) // 2
    rows, columns = np.mgrid[:height, :width]
    pattern = (
        generator.normal(0, 0.015)
        + generator.normal(0, 0.010) * (rows / height - 0.5)
        + generator.normal(0, 0.010) * (columns / width - 0.5)
        + generator.normal(0, 0.004, size=(height, width))
    )
    depth = parts.depth.copy()
    depth[half:] += pattern
    poses = parts.poses.copy()
    mount = np.eye(4)
    mount[:3, :3] = drawn_rotation(generator.uniform(0.5, 1.5), generator)
    mount[:3, 3] = generator.normal(0, 0.005, 3)
    poses[half:] = poses[half:] @ mount
    return parts.changed(depth=depth, poses=poses)


def one_pose_off(metres: float) -> Fault:
    """One pose is off by a distance, along the wall's normal: the way that shows."""

    def fault(parts: Parts, generator: np.random.Generator) -> Parts:
        poses = parts.poses.copy()
        k = int(generator.integers(len(poses)))
        poses[k, :3, 3] += metres * parts.normal[k] * generator.choice([-1, 1])
        return parts.changed(poses=poses)

    return fault


def one_pixel(parts: Parts, generator: np.random.Generator) -> Parts:
    """Images of 1 x 1 pixels: the one at the principal point."""
    camera = parts.header["camera"]
    v, u = round(camera.matrix[1][2]), round(camera.matrix[0][2])
    matrix = [list(row) for row in camera.matrix]
    matrix[0][2] -= u
    matrix[1][2] -= v
    rows = tuple(tuple(row) for row in matrix)
    small = replace(camera, width=1, height=1, matrix=rows, distortion=())
    cut = (slice(None), slice(v, v + 1), slice(u, u + 1))
    amplitude = None if parts.amplitude is None else parts.amplitude[cut]
    return parts.with_header(camera=small).changed(depth=parts.depth[cut], amplitude=amplitude)


TABLE: dict[str, Fault] = {
    "planes 37-50 deg off": planes_turned(37, 50),
    "planes 40 deg off": planes_turned(40, 40),
    "planes 5 deg off": planes_turned(5, 5),
    "all poses the same": lambda p, g: p.changed(poses=p.poses[[0] * len(p.poses)]),
    "all poses the identity": of_poses(np.eye(3), 0.0),
    "depth in millimetres": lambda p, g: p.changed(depth=1e3 * p.depth),
    "poses in millimetres": lambda p, g: p.changed(poses=scaled(p.poses, 1e3)),
    "radial given as z": other_kind,
    "z given as radial": z_as_radial,
    "normals flipped": lambda p, g: p.changed(normal=-p.normal, offset=-p.offset),
    "3 % of the pixels 0.7 m off": garbage(0.03, 0.7),
    "30 % garbage pixels": random_garbage(0.3),
    "quaternions as wxyz": lambda p, g: p.changed(poses=with_quaternions(p.poses, (3, 0, 1, 2))),
    "poses inverted": lambda p, g: p.changed(poses=np.linalg.inv(p.poses)),
    "left-handed world": lambda p, g: p.changed(poses=mirrored(p.poses, int(g.integers(3)))),
    "rows shifted by one": shifted,
    "mask inverted": inverted_mask,
    "two cameras mixed": two_cameras,
    "focal length 10 % off": focal_length(1.1),
    "one pose 100 mm off": one_pose_off(0.1),
    "five frames": lambda p, g: p.frames(np.sort(g.permutation(len(p.poses))[:5])),
    "depth stuck at 1 m": of_depth(np.ones_like),
    "1 x 1 pixels": one_pixel,
}
"""The rows of the table, by name."""


# Thirty kinds of wrong input as users make them.


def scaled_matrix(camera: CameraIntrinsics, factor: float) -> tuple[tuple[float, ...], ...]:
    """Return K of another resolution."""
    return tuple(
        tuple(value * (factor if row < 2 else 1.0) for value in line)
        for row, line in enumerate(camera.matrix)
    )


def copied_frames(parts: Parts, generator: np.random.Generator) -> Parts:
    """The camera hung: a fifth of the frames repeats the one before."""
    depth = parts.depth.copy()
    for k in range(1, len(depth), 5):
        depth[k] = depth[k - 1]
    return parts.changed(depth=depth)


def shuffled_poses(parts: Parts, generator: np.random.Generator) -> Parts:
    """Images sorted by name, 1, 10, 11, 2: poses and images are mixed up."""
    return parts.changed(poses=parts.poses[np.argsort([str(k) for k in range(len(parts.poses))])])


def shuffled_frames(parts: Parts, generator: np.random.Generator) -> Parts:
    """All rows in another order, stamps with them."""
    return parts.frames(generator.permutation(len(parts.poses)))


def swapped_walls(parts: Parts, generator: np.random.Generator) -> Parts:
    """A tenth of the frames shows another wall than the one recorded for it."""
    normal, offset = parts.normal.copy(), parts.offset.copy()
    chosen = generator.permutation(len(normal))[: max(len(normal) // 10, 1)]
    turn = drawn_rotation(60, generator)
    normal[chosen], offset[chosen] = normal[chosen] @ turn.T, offset[chosen] + 0.3
    return parts.changed(normal=normal, offset=offset)


def truncated_poses(parts: Parts, generator: np.random.Generator) -> Parts:
    """Poses written with one decimal: 100 mm."""
    poses = parts.poses.copy()
    poses[:, :3, 3] = np.round(poses[:, :3, 3], 1)
    return parts.changed(poses=poses)


def degrees_for_radians(parts: Parts, generator: np.random.Generator) -> Parts:
    """Rotation vectors in degrees, read as radians."""
    poses = parts.poses.copy()
    vector = Rotation.from_matrix(poses[:, :3, :3]).as_rotvec()
    poses[:, :3, :3] = Rotation.from_rotvec(np.degrees(vector)).as_matrix()
    return parts.changed(poses=poses)


def other_euler_order(parts: Parts, generator: np.random.Generator) -> Parts:
    """Roll, pitch and yaw put together in the opposite order."""
    poses = parts.poses.copy()
    angles = Rotation.from_matrix(poses[:, :3, :3]).as_euler("xyz")
    poses[:, :3, :3] = Rotation.from_euler("zyx", angles[:, ::-1]).as_matrix()
    # Read back as if the angles belonged to the other axes.
    poses[:, :3, :3] = Rotation.from_euler("XYZ", angles).as_matrix()
    return parts.changed(poses=poses)


def drifting_poses(parts: Parts, generator: np.random.Generator) -> Parts:
    """Odometry instead of an arm: the place drifts by 200 mm over the recording."""
    poses = parts.poses.copy()
    away = generator.normal(size=3)
    away /= np.linalg.norm(away)
    poses[:, :3, 3] += np.linspace(0, 0.2, len(poses))[:, None] * away
    return parts.changed(poses=poses)


def offset_lost(parts: Parts, generator: np.random.Generator) -> Parts:
    """Every plane goes through the origin of a world that lies elsewhere."""
    poses = parts.poses.copy()
    poses[:, :3, 3] += [0.4, -0.3, 0.5]
    return parts.changed(poses=poses)


def amplitude_for_depth(parts: Parts, generator: np.random.Generator) -> Parts:
    """Depth and amplitude exchanged."""
    assert parts.amplitude is not None
    return parts.changed(depth=parts.amplitude, amplitude=np.nan_to_num(parts.depth))


def a_sphere(parts: Parts, generator: np.random.Generator) -> Parts:
    """The wall is no plane: it comes nearer by 100 mm with the square of a metre on it."""
    camera = parts.poses @ parts.header["tool_from_camera"]
    points = ray_directions(parts.header["camera"]).numpy() * parts.depth[..., None]
    world = np.einsum("fab,fhwb->fhwa", camera[:, :3, :3], points) + camera[:, None, None, :3, 3]
    middle = np.median(world.reshape(-1, 3), axis=0)
    away = np.linalg.norm(world - middle, axis=-1)
    return parts.changed(depth=parts.depth - 0.1 * away**2)


def a_table_below(parts: Parts, generator: np.random.Generator) -> Parts:
    """The lower fifth of every image shows a table in front of the wall, nowhere masked."""
    depth = parts.depth.copy()
    rows = depth.shape[1] // 5
    depth[:, -rows:] *= np.linspace(0.9, 0.5, rows)[:, None]
    return parts.changed(depth=depth)


def several_poses_off(parts: Parts, generator: np.random.Generator) -> Parts:
    """Every eighth pose is off by 60 to 200 mm in some direction, and by some degrees."""
    poses = parts.poses.copy()
    for k in range(0, len(poses), 8):
        step = generator.normal(size=3)
        poses[k, :3, 3] += generator.uniform(0.06, 0.2) * step / np.linalg.norm(step)
        poses[k, :3, :3] = drawn_rotation(generator.uniform(3, 10), generator) @ poses[k, :3, :3]
    return parts.changed(poses=poses)


def half_the_poses(parts: Parts, generator: np.random.Generator) -> Parts:
    """The second half of the poses is of another world: the robot was re-homed."""
    poses = parts.poses.copy()
    turn = np.eye(4)
    turn[:3, :3] = drawn_rotation(10, generator)
    turn[:3, 3] = generator.normal(0, 0.1, 3)
    half = len(poses) // 2
    poses[half:] = turn @ poses[half:]
    return parts.changed(poses=poses)


FURTHER: dict[str, Fault] = {
    "images mirrored": of_images(lambda images: images[:, :, ::-1]),
    "images upside down": of_images(lambda images: images[:, ::-1]),
    "K of half the resolution": lambda p, g: camera_with(
        p, matrix=scaled_matrix(p.header["camera"], 0.5)
    ),
    "principal point of a crop": lambda p, g: with_lens(p, shift=(0.25 * p.depth.shape[2], 0.0)),
    "depth in centimetres": lambda p, g: p.changed(depth=1e2 * p.depth),
    "depth in inches": lambda p, g: p.changed(depth=p.depth / 0.0254),
    "depth in feet": lambda p, g: p.changed(depth=p.depth / 0.3048),
    "depth divided by 1000 twice": lambda p, g: p.changed(depth=1e-3 * p.depth),
    "depth wrapped at 1 m": of_depth(lambda depth: np.mod(depth, 1.0)),
    "depth with exchanged bytes": of_depth(swapped_bytes),
    "depth and amplitude exchanged": amplitude_for_depth,
    "depth is noise": lambda p, g: p.changed(depth=g.uniform(0.3, 3.0, p.depth.shape)),
    "depth rounded to 50 mm": of_depth(lambda depth: np.round(depth / 0.05) * 0.05),
    "depth clipped": of_depth(lambda depth: np.minimum(depth, np.nanquantile(depth, 0.7))),
    "camera hung for a fifth": copied_frames,
    "camera hung for good": of_depth(lambda depth: np.repeat(depth[:1], len(depth), axis=0)),
    "poses sorted as text": shuffled_poses,
    "all rows shuffled": shuffled_frames,
    "a tenth of another wall": swapped_walls,
    "poses with one decimal": truncated_poses,
    "rotations in degrees": degrees_for_radians,
    "angles in another order": other_euler_order,
    "poses that drift 200 mm": drifting_poses,
    "planes of another origin": offset_lost,
    "poses without translations": of_poses(None, 0.0),
    "poses without rotations": of_poses(np.eye(3)),
    "poses in centimetres": lambda p, g: p.changed(poses=scaled(p.poses, 1e2)),
    "poses in inches": lambda p, g: p.changed(poses=scaled(p.poses, 1 / 0.0254)),
    "poses of a mirrored y axis": lambda p, g: p.changed(poses=mirrored(p.poses, 1)),
    "a curved target": a_sphere,
    "a table in the image": a_table_below,
    "every eighth pose off": several_poses_off,
    "amplitude of one value": lambda p, g: p.changed(amplitude=np.full(p.depth.shape, 100.0)),
    "robot homed anew half way": half_the_poses,
}
"""The faults, by name."""


# Thought of after the checks were written.


def two_worlds(parts: Parts, generator: np.random.Generator) -> Parts:
    """Two recordings joined, the robot's base moved by 60 mm and 4 degrees between them."""
    poses = parts.poses.copy()
    moved = drawn_motion(0.06, 4, generator)
    cut = int(generator.integers(len(poses) // 4, 3 * len(poses) // 4))
    poses[cut:] = moved @ poses[cut:]
    return parts.changed(poses=poses)


def varying_lag(parts: Parts, generator: np.random.Generator) -> Parts:
    """Every pose was read too late, by up to a twentieth of the way to the next."""
    poses = parts.poses.copy()
    for k in range(len(poses) - 1):
        share = generator.uniform(0, 0.05)
        pair = Rotation.from_matrix(parts.poses[k : k + 2, :3, :3])
        poses[k, :3, :3] = Slerp([0, 1], pair)(share).as_matrix()
        poses[k, :3, 3] += share * (parts.poses[k + 1, :3, 3] - parts.poses[k, :3, 3])
    return parts.changed(poses=poses)


def tangential_last(parts: Parts, generator: np.random.Generator) -> Parts:
    """A strong lens whose coefficients are in the order k1 k2 k3 p1 p2."""
    k1, k2, p1, p2, k3 = (*parts.header["camera"].distortion, 0.0, 0.0, 0.0, 0.0, 0.0)[:5]
    k3 = k3 or generator.uniform(0.05, 0.15)
    return camera_with(parts, distortion=(k1, k2, k3, p1, p2))


def distortion_left_out(parts: Parts, generator: np.random.Generator) -> Parts:
    """The header has no distortion, and the lens has one."""
    return camera_with(parts, distortion=())


def distorted_twice(parts: Parts, generator: np.random.Generator) -> Parts:
    """The images are rectified, and the header has the lens's distortion, here a strong one."""
    k1, k2, *others = parts.header["camera"].distortion or (0.0,) * 5
    return camera_with(parts, distortion=(k1 - 0.25, k2 + 0.08, *others))


def other_exposure(parts: Parts, generator: np.random.Generator) -> Parts:
    """Every second frame has four times the exposure: other amplitude, other distance."""
    assert parts.amplitude is not None
    depth, amplitude = parts.depth.copy(), parts.amplitude.copy()
    depth[::2] += generator.choice([-1, 1]) * generator.uniform(0.02, 0.04)
    amplitude[::2] *= 4
    return parts.changed(depth=depth, amplitude=amplitude)


def averaged_in_time(parts: Parts, generator: np.random.Generator) -> Parts:
    """The camera averages successive frames: a tenth of each image is the one before."""
    depth = parts.depth.copy()
    depth[1:] = 0.9 * depth[1:] + 0.1 * parts.depth[:-1]
    return parts.changed(depth=depth)


def thick_board(parts: Parts, generator: np.random.Generator) -> Parts:
    """The board stands 30 mm before the wall, and has the wall's plane."""
    board = parts.target == parts.target[-1]
    normal = parts.normal[board]
    poses = parts.poses.copy()
    # The board comes nearer, as if the camera stood nearer to the wall.
    poses[board, :3, 3] += 0.03 * normal
    return parts.changed(poses=poses)


def amplitude_of_another(parts: Parts, generator: np.random.Generator) -> Parts:
    """Amplitude images are one frame late."""
    assert parts.amplitude is not None
    return parts.changed(amplitude=np.roll(parts.amplitude, 1, axis=0))


def other_flange(parts: Parts, generator: np.random.Generator) -> Parts:
    """Half of the frames, at random, have the pose of another tool frame: 20 mm and 2 degrees."""
    poses = parts.poses.copy()
    tool = drawn_motion(0.02, 2, generator)
    chosen = generator.uniform(size=len(poses)) < 0.5
    poses[chosen] = poses[chosen] @ tool
    return parts.changed(poses=poses)


def scaled_robot(parts: Parts, generator: np.random.Generator) -> Parts:
    """The robot's lengths are 4 % off."""
    poses = parts.poses.copy()
    poses[:, :3, 3] *= 1.04 if generator.uniform() < 0.5 else 1 / 1.04
    return parts.changed(poses=poses)


def filled_holes(parts: Parts, generator: np.random.Generator) -> Parts:
    """A driver fills every tenth pixel with its last value: that of the frame before."""
    hit = generator.uniform(size=parts.depth.shape) < 0.1
    return parts.changed(depth=np.where(hit, np.roll(parts.depth, 1, axis=0), parts.depth))


def another_target(parts: Parts, generator: np.random.Generator) -> Parts:
    """The wall stands 40 to 80 mm behind the recorded one, and is tilted by 1.5 degrees."""
    turn = Rotation.from_rotvec(
        np.radians(1.5) * np.cross(parts.normal[0], generator.normal(size=3))
    ).as_matrix()
    return replace(
        parts, normal=parts.normal @ turn.T, offset=parts.offset + generator.uniform(0.04, 0.08)
    )


def other_sign(parts: Parts, generator: np.random.Generator) -> Parts:
    """The wall stands a metre from the origin of the world, and d has the sign of n . x = d."""
    poses = parts.poses.copy()
    poses[:, :3, 3] += parts.normal
    return parts.changed(poses=poses, offset=1.0 - parts.offset)


def remounted(parts: Parts, generator: np.random.Generator) -> Parts:
    """The last quarter was recorded after the camera was knocked: 8 mm and 1 degree."""
    poses = parts.poses.copy()
    tool = drawn_motion(0.008, 1, generator)
    cut = 3 * len(poses) // 4
    poses[cut:] = poses[cut:] @ tool
    return parts.changed(poses=poses)


UNLISTED: dict[str, Fault] = {
    "two worlds joined": two_worlds,
    "poses too late by a varying lag": varying_lag,
    "distortion as k1 k2 k3 p1 p2": tangential_last,
    "distortion left out": distortion_left_out,
    "distortion of rectified images": distorted_twice,
    "principal point exchanged": centre_exchanged,
    "one focal length 10 % off": wider_pixels,
    # of 1/64 mm, which start at zero again beyond 1.024 m
    "counts of 16 bits that wrap": of_depth(
        lambda depth: np.round(64e3 * np.nan_to_num(depth)).astype(np.int64) % 65536 / 64e3
    ),
    "every second frame of another exposure": other_exposure,
    "frames averaged in time": averaged_in_time,
    "a board 30 mm before the wall": thick_board,
    "amplitude one frame late": amplitude_of_another,
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
"""The faults, by name."""
