"""Whether a matrix read from a file is a rigid transform."""

import numpy as np

# Largest deviation of a rotation from an orthonormal matrix (no unit): rounding to three digits.
_TOLERANCE = 1e-3
# Smallest deviation that is corrected (no unit): smaller ones are rounding errors of float64.
_EXACT = 1e-12


def refuse_unless_rigid(matrix: np.ndarray) -> None:
    """Refuse a matrix that is not a finite rigid transform of shape (4, 4).

    Raises:
        ValueError: It is not; the message says why.
    """
    if matrix.shape != (4, 4) or not np.isfinite(matrix).all():
        raise ValueError("expected a 4x4 matrix of finite numbers")
    if np.any(matrix[3] != [0, 0, 0, 1]):
        raise ValueError("the last row of a rigid transform is 0 0 0 1")
    rotation = matrix[:3, :3]
    # Entries above 2 cannot belong to a rotation, and their squares may overflow.
    if np.abs(rotation).max() > 2 or (
        np.abs(rotation @ rotation.T - np.eye(3)).max() > 2 * _TOLERANCE
    ):
        raise ValueError("the upper left 3x3 block must be a rotation: orthonormal, to 0.001")
    if np.linalg.det(rotation) < 0:
        raise ValueError("the upper left 3x3 block is a reflection, not a rotation")


def nearest_rigid(matrix: np.ndarray) -> np.ndarray:
    """Return the transform with its rotation made exact, shape (4, 4).

    Because of rounding in a file a rotation is only nearly orthonormal; the nearest rotation is
    returned.
    """
    left, _, right = np.linalg.svd(matrix[:3, :3])
    exact = matrix.copy()
    if np.abs(left @ right - matrix[:3, :3]).max() > _EXACT:
        exact[:3, :3] = left @ right
    return exact
