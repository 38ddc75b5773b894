"""Rotation matrices as quaternions and as rotation vectors."""

import numpy as np


def quaternion_from_matrix(rotation: np.ndarray) -> np.ndarray:
    """Return the unit quaternion of a rotation matrix.

    Of the four forms that give it, the one is taken whose divisor is largest (Shepperd 1978).

    Args:
        rotation: Shape (3, 3).

    Returns:
        Scalar last, shape (4,); its largest component is positive.
    """
    trace = rotation.trace()
    decision = np.array([*rotation.diagonal(), trace])
    largest = int(decision.argmax())
    skew = np.array(
        [
            rotation[2, 1] - rotation[1, 2],
            rotation[0, 2] - rotation[2, 0],
            rotation[1, 0] - rotation[0, 1],
        ]
    )
    if largest == 3:
        quaternion = np.array([*skew, 1 + trace])
    else:
        symmetric = rotation[largest] + rotation[:, largest]
        symmetric[largest] += 1 - trace
        quaternion = np.array([*symmetric, skew[largest]])
    return quaternion / np.linalg.norm(quaternion)


def rotation_vector_from_matrix(rotation: np.ndarray) -> np.ndarray:
    """Return the rotation vector of a rotation matrix: its axis times its angle in radians.

    Args:
        rotation: Shape (3, 3).

    Returns:
        Shape (3,); its length is at most pi.
    """
    quaternion = quaternion_from_matrix(rotation)
    if quaternion[3] < 0:
        quaternion = -quaternion
    sine = float(np.linalg.norm(quaternion[:3]))
    if sine == 0:
        return np.zeros(3)
    return quaternion[:3] * (2 * np.arctan2(sine, quaternion[3]) / sine)
