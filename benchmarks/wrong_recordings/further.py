"""Further faults, not in the table: thirty kinds of wrong input as users make them."""

from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from benchmarks.wrong_recordings.parts import Parts
from benchmarks.wrong_recordings.rigid import drawn_rotation, mirrored, scaled
from benchmarks.wrong_recordings.table import Fault
from tofcorr.geometry.camera import CameraIntrinsics
from tofcorr.geometry.rays import ray_directions


def camera_with(parts: Parts, **changes: object) -> Parts:
    """Return the recording with another camera in its header."""
    return parts.with_header(camera=replace(parts.header["camera"], **changes))


def scaled_matrix(camera: CameraIntrinsics, factor: float) -> tuple[tuple[float, ...], ...]:
    """Return K of another resolution."""
    return tuple(
        tuple(value * (factor if row < 2 else 1.0) for value in line)
        for row, line in enumerate(camera.matrix)
    )


def centre_moved(parts: Parts, generator: np.random.Generator) -> Parts:
    """The principal point is that of a crop."""
    matrix = [list(row) for row in parts.header["camera"].matrix]
    matrix[0][2] += 0.25 * parts.depth.shape[2]
    return camera_with(parts, matrix=tuple(tuple(row) for row in matrix))


def flipped_columns(parts: Parts, generator: np.random.Generator) -> Parts:
    """The driver mirrors its images."""
    amplitude = None if parts.amplitude is None else parts.amplitude[:, :, ::-1]
    return parts.changed(depth=parts.depth[:, :, ::-1], amplitude=amplitude)


def flipped_rows(parts: Parts, generator: np.random.Generator) -> Parts:
    """The images are upside down."""
    amplitude = None if parts.amplitude is None else parts.amplitude[:, ::-1]
    return parts.changed(depth=parts.depth[:, ::-1], amplitude=amplitude)


def wrapped(parts: Parts, generator: np.random.Generator) -> Parts:
    """Depth beyond a metre starts again at zero: stored modulo a short range."""
    return parts.changed(depth=np.mod(parts.depth, 1.0))


def sixteen_bits(parts: Parts, generator: np.random.Generator) -> Parts:
    """Bytes of 16-bit millimetres exchanged (big-endian read as little-endian)."""
    counts = np.round(1e3 * np.nan_to_num(parts.depth)).astype(np.uint16)
    return parts.changed(depth=counts.byteswap().astype(float) / 1e3)


def copied_frames(parts: Parts, generator: np.random.Generator) -> Parts:
    """The camera hung: a fifth of the frames repeats the one before."""
    depth = parts.depth.copy()
    for k in range(1, len(depth), 5):
        depth[k] = depth[k - 1]
    return parts.changed(depth=depth)


def frozen(parts: Parts, generator: np.random.Generator) -> Parts:
    """The camera hung for good: every frame is the first."""
    return parts.changed(depth=np.repeat(parts.depth[:1], len(parts.depth), axis=0))


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


def rounded(step: float) -> Fault:
    """Depth rounded to a step in metres."""
    return lambda parts, generator: parts.changed(depth=np.round(parts.depth / step) * step)


def clipped(parts: Parts, generator: np.random.Generator) -> Parts:
    """Everything beyond the 70 % quantile reads that distance."""
    return parts.changed(depth=np.minimum(parts.depth, np.nanquantile(parts.depth, 0.7)))


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


def rotation_only(parts: Parts, generator: np.random.Generator) -> Parts:
    """The translations were never filled in."""
    poses = parts.poses.copy()
    poses[:, :3, 3] = 0.0
    return parts.changed(poses=poses)


def translation_only(parts: Parts, generator: np.random.Generator) -> Parts:
    """The quaternions were never filled in."""
    poses = parts.poses.copy()
    poses[:, :3, :3] = np.eye(3)
    return parts.changed(poses=poses)


def noise_images(parts: Parts, generator: np.random.Generator) -> Parts:
    """The depth is noise."""
    return parts.changed(depth=generator.uniform(0.3, 3.0, parts.depth.shape))


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


def constant_amplitude(parts: Parts, generator: np.random.Generator) -> Parts:
    """The amplitude was never read: 100 everywhere."""
    return parts.changed(amplitude=np.full(parts.depth.shape, 100.0))


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
    "images mirrored": flipped_columns,
    "images upside down": flipped_rows,
    "K of half the resolution": lambda p, g: camera_with(
        p, matrix=scaled_matrix(p.header["camera"], 0.5)
    ),
    "principal point of a crop": centre_moved,
    "depth in centimetres": lambda p, g: p.changed(depth=1e2 * p.depth),
    "depth in inches": lambda p, g: p.changed(depth=p.depth / 0.0254),
    "depth in feet": lambda p, g: p.changed(depth=p.depth / 0.3048),
    "depth divided by 1000 twice": lambda p, g: p.changed(depth=1e-3 * p.depth),
    "depth wrapped at 1 m": wrapped,
    "depth with exchanged bytes": sixteen_bits,
    "depth and amplitude exchanged": amplitude_for_depth,
    "depth is noise": noise_images,
    "depth rounded to 50 mm": rounded(0.05),
    "depth clipped": clipped,
    "camera hung for a fifth": copied_frames,
    "camera hung for good": frozen,
    "poses sorted as text": shuffled_poses,
    "all rows shuffled": shuffled_frames,
    "a tenth of another wall": swapped_walls,
    "poses with one decimal": truncated_poses,
    "rotations in degrees": degrees_for_radians,
    "angles in another order": other_euler_order,
    "poses that drift 200 mm": drifting_poses,
    "planes of another origin": offset_lost,
    "poses without translations": rotation_only,
    "poses without rotations": translation_only,
    "poses in centimetres": lambda p, g: p.changed(poses=scaled(p.poses, 1e2)),
    "poses in inches": lambda p, g: p.changed(poses=scaled(p.poses, 1 / 0.0254)),
    "poses of a mirrored y axis": lambda p, g: p.changed(poses=mirrored(p.poses, 1)),
    "a curved target": a_sphere,
    "a table in the image": a_table_below,
    "every eighth pose off": several_poses_off,
    "amplitude of one value": constant_amplitude,
    "robot homed anew half way": half_the_poses,
}
"""The faults, by name."""
