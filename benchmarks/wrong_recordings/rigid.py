"""Rotations drawn and rewritten, in NumPy and SciPy alone."""

import numpy as np
from scipy.spatial.transform import Rotation


def drawn_rotation(degrees: float, generator: np.random.Generator) -> np.ndarray:
    """Return a rotation by this angle about a random axis, shape (3, 3)."""
    axis = generator.normal(size=3)
    return Rotation.from_rotvec(np.radians(degrees) * axis / np.linalg.norm(axis)).as_matrix()


def drawn_motion(metres: float, degrees: float, generator: np.random.Generator) -> np.ndarray:
    """Return a turn by this angle and a shift by this length, both at random, shape (4, 4)."""
    motion = np.eye(4)
    motion[:3, :3] = drawn_rotation(degrees, generator)
    step = generator.normal(size=3)
    motion[:3, 3] = metres * step / np.linalg.norm(step)
    return motion


def with_quaternions(poses: np.ndarray, order: tuple[int, int, int, int]) -> np.ndarray:
    """Return poses whose quaternions' entries x y z w are taken in another order."""
    changed = poses.copy()
    quaternion = Rotation.from_matrix(poses[:, :3, :3]).as_quat()[:, list(order)]
    changed[:, :3, :3] = Rotation.from_quat(quaternion).as_matrix()
    return changed


def mirrored(poses: np.ndarray, axis: int) -> np.ndarray:
    """Return poses as a left-handed program writes them: one axis of the world turned round."""
    sign = np.ones(3)
    sign[axis] = -1
    changed = poses.copy()
    changed[:, :3, :3] = sign[:, None] * poses[:, :3, :3] * sign
    changed[:, :3, 3] = sign * poses[:, :3, 3]
    return changed


def scaled(poses: np.ndarray, factor: float) -> np.ndarray:
    """Return poses with their translations in another unit."""
    changed = poses.copy()
    changed[:, :3, 3] *= factor
    return changed
