"""Rigid transforms as stacked 4x4 matrices."""

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def rotations(vectors: Array) -> Array:
    """Rotation matrices (..., 3, 3) of rotation vectors (..., 3), by Rodrigues' formula."""
    angle = np.linalg.norm(vectors, axis=-1, keepdims=True)
    axis = vectors / np.where(angle > 0, angle, 1.0)
    x, y, z = np.moveaxis(axis, -1, 0)
    o = np.zeros_like(x)
    cross = np.stack([o, -z, y, z, o, -x, -y, x, o], axis=-1).reshape(*x.shape, 3, 3)
    angle = angle[..., None]
    return np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross


def transforms(rotation: Array, translation: Array) -> Array:
    """Stack rotations (..., 3, 3) and translations (..., 3) to (..., 4, 4)."""
    result = np.zeros((*translation.shape[:-1], 4, 4))
    result[..., :3, :3] = rotation
    result[..., :3, 3] = translation
    result[..., 3, 3] = 1.0
    return result


def inverse(matrices: Array) -> Array:
    """Inverse of rigid transforms (..., 4, 4)."""
    rotation = np.swapaxes(matrices[..., :3, :3], -1, -2)
    return transforms(rotation, -(rotation @ matrices[..., :3, 3:])[..., 0])


def small_motions(translation: Array, rotation: Array) -> Array:
    """Transforms (..., 4, 4) of translations and rotation vectors, both (..., 3)."""
    return transforms(rotations(rotation), translation)


def quaternions(matrices: Array) -> Array:
    """Unit quaternions x, y, z, w (N, 4) of rotations (N, 3, 3), by Bar-Itzhack's matrix."""
    m = matrices
    trace = np.trace(m, axis1=-2, axis2=-1)
    k = np.empty((len(m), 4, 4))
    k[:, :3, :3] = m + np.swapaxes(m, -1, -2) - trace[:, None, None] * np.eye(3)
    skew = np.stack([m[:, 2, 1] - m[:, 1, 2], m[:, 0, 2] - m[:, 2, 0], m[:, 1, 0] - m[:, 0, 1]], -1)
    k[:, :3, 3] = k[:, 3, :3] = skew
    k[:, 3, 3] = trace
    result = np.linalg.eigh(k)[1][..., -1]
    return result * np.where(result[:, 3:] < 0, -1.0, 1.0)
