"""Mistakes in poses (F, 4, 4), undone."""

import numpy as np
import torch

from tofcorr.geometry import se3


def reordered(poses: np.ndarray) -> np.ndarray:
    """Return the poses whose quaternions, read as x y z w, were written as w x y z."""
    x, y, z, w = _quaternions(poses).T
    return _with_quaternions(poses, np.stack([y, z, w, x], axis=1))


def transposed(poses: np.ndarray) -> np.ndarray:
    """Return the poses with their rotations inverted, their translations as they are."""
    changed = poses.copy()
    changed[:, :3, :3] = np.swapaxes(poses[:, :3, :3], 1, 2)
    return changed


def mirrored(poses: np.ndarray, axis: int) -> np.ndarray:
    """Return the poses of a world with one axis turned round."""
    sign = np.ones(4)
    sign[axis] = -1
    return sign[:, None] * poses * sign


def exchanged(poses: np.ndarray, first: int, second: int) -> np.ndarray:
    """Return the poses of a world with two axes exchanged."""
    order = np.arange(4)
    order[[first, second]] = order[[second, first]]
    return poses[:, order][:, :, order]


def _quaternions(poses: np.ndarray) -> np.ndarray:
    from scipy.spatial.transform import Rotation

    return Rotation.from_matrix(poses[:, :3, :3]).as_quat()


def _with_quaternions(poses: np.ndarray, quaternions: np.ndarray) -> np.ndarray:
    return se3.matrix_from_quaternion_translation(
        torch.from_numpy(quaternions), torch.from_numpy(poses[:, :3, 3].copy())
    ).numpy()
