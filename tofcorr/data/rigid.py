"""Whether a matrix read from a file is a rigid transform."""

import numpy as np

# How far a rotation may be from orthonormal: what rounding to three digits does to it.
_TOLERANCE = 1e-3
# Below this it is the rounding of float64, and nothing is gained by touching it.
_EXACT = 1e-12


def refuse_unless_rigid(matrix: np.ndarray) -> None:
    """Refuse anything but a finite rigid transform of shape (4, 4).

    Raises:
        ValueError: The message says what is wrong with the matrix.
    """
    if matrix.shape != (4, 4) or not np.isfinite(matrix).all():
        raise ValueError("expected a 4x4 matrix of finite numbers")
    if np.any(matrix[3] != [0, 0, 0, 1]):
        raise ValueError("the last row of a rigid transform is 0 0 0 1")
    rotation = matrix[:3, :3]
    # Entries beyond 2 cannot belong to a rotation, and their squares may overflow.
    if np.abs(rotation).max() > 2 or (
        np.abs(rotation @ rotation.T - np.eye(3)).max() > 2 * _TOLERANCE
    ):
        raise ValueError("the upper left 3x3 block must be a rotation: orthonormal, to 0.001")
    if np.linalg.det(rotation) < 0:
        raise ValueError("the upper left 3x3 block is a reflection, not a rotation")


def nearest_rigid(matrix: np.ndarray) -> np.ndarray:
    """Return the transform with its rotation made exact, shape (4, 4).

    Rounding in a file leaves a rotation almost orthonormal; the nearest one is taken, as a
    quaternion of almost unit length is normalised.
    """
    left, _, right = np.linalg.svd(matrix[:3, :3])
    exact = matrix.copy()
    if np.abs(left @ right - matrix[:3, :3]).max() > _EXACT:
        exact[:3, :3] = left @ right
    return exact
