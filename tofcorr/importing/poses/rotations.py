"""Rigid transforms from the rotations that pose files use."""

import numpy as np

_UNIT_TOLERANCE = 1e-3
"""How far the length of a quaternion may be from one: what three decimals do to it."""

_WHOLE_TURN = 2 * np.pi + 1e-3
"""Largest angle of a rotation vector, radians: a turn, and rounding. Derived: robots report half a
turn at most, some up to a whole one."""


def matrix_from_quaternion(translation: np.ndarray, quaternion_xyzw: np.ndarray) -> np.ndarray:
    """Return a rigid transform, shape (4, 4).

    Args:
        translation: Shape (3,), metres.
        quaternion_xyzw: Shape (4,), scalar last, of unit length to 0.001.

    Raises:
        ValueError: The quaternion is not of unit length.
    """
    length = float(np.linalg.norm(quaternion_xyzw))
    if not abs(length - 1) <= _UNIT_TOLERANCE:
        raise ValueError(f"the quaternion (x, y, z, w) has length {length:.4g}; expected 1")
    x, y, z, w = quaternion_xyzw / length
    transform = np.eye(4)
    transform[:3, :3] = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    transform[:3, 3] = translation
    return transform


def matrix_from_rotation_vector(translation: np.ndarray, vector: np.ndarray) -> np.ndarray:
    """Return a rigid transform of an axis times an angle in radians (as UR robots report).

    Raises:
        ValueError: The angle is more than a turn.
    """
    angle = float(np.linalg.norm(vector))
    if not angle <= _WHOLE_TURN:
        raise ValueError(
            f"rx, ry, rz are read as an axis times an angle in radians, and the angle is "
            f"{angle:.4g}; degrees, or Euler angles, must be turned into quaternions qx, qy, qz, qw"
        )
    half = 0.5 * angle
    # sin(a / 2) / a tends to 1 / 2: no division by an angle of zero.
    scale = 0.5 if angle < 1e-8 else np.sin(half) / angle
    return matrix_from_quaternion(translation, np.array([*(scale * vector), np.cos(half)]))
