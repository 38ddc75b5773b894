"""Faults that no list named before: thought of after the checks were written."""

from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from benchmarks.wrong_recordings.further import camera_with
from benchmarks.wrong_recordings.parts import Parts
from benchmarks.wrong_recordings.rigid import drawn_motion
from benchmarks.wrong_recordings.table import Fault


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


def centre_exchanged(parts: Parts, generator: np.random.Generator) -> Parts:
    """The principal point is written as row and column."""
    matrix = [list(row) for row in parts.header["camera"].matrix]
    matrix[0][2], matrix[1][2] = matrix[1][2], matrix[0][2]
    return camera_with(parts, matrix=tuple(tuple(row) for row in matrix))


def wider_pixels(parts: Parts, generator: np.random.Generator) -> Parts:
    """Rows were binned and columns were not: one focal length is 10 % off."""
    matrix = [list(row) for row in parts.header["camera"].matrix]
    matrix[0][0] *= 1.1 if generator.uniform() < 0.5 else 1 / 1.1
    return camera_with(parts, matrix=tuple(tuple(row) for row in matrix))


def wrapped_counts(parts: Parts, generator: np.random.Generator) -> Parts:
    """Counts of 16 bits, of 1/64 mm, that start again at zero beyond 1.024 m."""
    counts = np.round(64e3 * np.nan_to_num(parts.depth)).astype(np.int64) % 65536
    return parts.changed(depth=counts / 64e3)


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


def two_pixels_off(parts: Parts, generator: np.random.Generator) -> Parts:
    """Images are rolled by two columns."""
    amplitude = None if parts.amplitude is None else np.roll(parts.amplitude, 2, axis=2)
    return parts.changed(depth=np.roll(parts.depth, 2, axis=2), amplitude=amplitude)


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


def blended(parts: Parts, generator: np.random.Generator) -> Parts:
    """A filter drags every pixel towards its median over the recording, by a twentieth."""
    usual = np.nanmedian(parts.depth, axis=0)
    return parts.changed(depth=0.95 * parts.depth + 0.05 * usual)


UNLISTED: dict[str, Fault] = {
    "two worlds joined": two_worlds,
    "poses too late by a varying lag": varying_lag,
    "distortion as k1 k2 k3 p1 p2": tangential_last,
    "distortion left out": distortion_left_out,
    "distortion of rectified images": distorted_twice,
    "principal point exchanged": centre_exchanged,
    "one focal length 10 % off": wider_pixels,
    "counts of 16 bits that wrap": wrapped_counts,
    "every second frame of another exposure": other_exposure,
    "frames averaged in time": averaged_in_time,
    "a board 30 mm before the wall": thick_board,
    "amplitude one frame late": amplitude_of_another,
    "images rolled by two columns": two_pixels_off,
    "half of the poses of another flange": other_flange,
    "a robot 4 % too long": scaled_robot,
    "holes filled from the frame before": filled_holes,
    "a wall 60 mm behind": another_target,
    "planes as n . x = d": other_sign,
    "poses of the camera before it was remounted": remounted,
    "depth of every pixel's median over the frames": blended,
}
"""The faults, by name."""
