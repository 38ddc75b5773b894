"""The faults of the table in issue 16: what once passed with a confident number."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from benchmarks.wrong_recordings.parts import Parts
from benchmarks.wrong_recordings.rigid import drawn_rotation, mirrored, scaled, with_quaternions
from tofcorr.geometry.rays import ray_directions

Fault = Callable[[Parts, np.random.Generator], Parts]


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


def same_poses(parts: Parts, generator: np.random.Generator) -> Parts:
    """Every frame has the first frame's pose."""
    return parts.changed(poses=np.repeat(parts.poses[:1], len(parts.poses), axis=0))


def identity_poses(parts: Parts, generator: np.random.Generator) -> Parts:
    """Poses were never written, the planes are those of the world."""
    return parts.changed(poses=np.repeat(np.eye(4)[None], len(parts.poses), axis=0))


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


def focal_length(factor: float) -> Fault:
    """The focal length of the header is off by a factor."""

    def fault(parts: Parts, generator: np.random.Generator) -> Parts:
        camera = parts.header["camera"]
        matrix = [list(row) for row in camera.matrix]
        factors = factor if generator.uniform() < 0.5 else 1 / factor
        matrix[0][0] *= factors
        matrix[1][1] *= factors
        return parts.with_header(camera=replace(camera, matrix=tuple(tuple(r) for r in matrix)))

    return fault


def one_pose_off(metres: float) -> Fault:
    """One pose is off by a distance, along the wall's normal: the way that shows."""

    def fault(parts: Parts, generator: np.random.Generator) -> Parts:
        poses = parts.poses.copy()
        k = int(generator.integers(len(poses)))
        poses[k, :3, 3] += metres * parts.normal[k] * generator.choice([-1, 1])
        return parts.changed(poses=poses)

    return fault


def stuck_depth(parts: Parts, generator: np.random.Generator) -> Parts:
    """Every pixel reads one metre."""
    return parts.changed(depth=np.ones_like(parts.depth))


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
    "all poses the same": same_poses,
    "all poses the identity": identity_poses,
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
    "depth stuck at 1 m": stuck_depth,
    "1 x 1 pixels": one_pixel,
}
"""The rows of the table, by name."""
