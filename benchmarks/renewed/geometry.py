"""Rigid transforms as stacked 4x4 matrices, and the camera: intrinsics and viewing rays."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

Array = NDArray[np.float64]
Random = np.random.Generator
SPEED_OF_LIGHT = 299_792_458.0  # m/s


def rotations(vectors: Array) -> Array:
    """Rotation matrices (..., 3, 3) of rotation vectors (..., 3)."""
    matrices = Rotation.from_rotvec(vectors.reshape(-1, 3)).as_matrix()
    return matrices.reshape(*vectors.shape, 3)


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


def image_grid(height: int, width: int) -> tuple[Array, Array]:
    """Column and row (H, W) of every pixel, each from -1 to 1."""
    column, row = np.meshgrid(np.linspace(-1, 1, width), np.linspace(-1, 1, height))
    return column, row


@dataclass(frozen=True)
class Camera:
    """A camera with OpenCV's five-coefficient lens model; `sensitivity` is in electrons."""

    width: int
    height: int
    focal: tuple[float, float]
    centre: tuple[float, float]
    distortion: tuple[float, float, float, float, float]
    sensitivity: float  # amplitude of a white target at 1 m, at nominal exposure, electrons
    counts_per_electron: float

    @property
    def matrix(self) -> list[list[float]]:
        """The 3x3 intrinsic matrix as nested lists."""
        (u, v), (fx, fy) = self.centre, self.focal
        return [[fx, 0.0, u], [0.0, fy, v], [0.0, 0.0, 1.0]]

    def slopes(self) -> tuple[Array, Array]:
        """Undistorted x/z and y/z (H, W) of every pixel, by Newton's method on the lens model."""
        column, row = np.meshgrid(np.arange(self.width, dtype=float), np.arange(self.height))
        (u, v), (fx, fy) = self.centre, self.focal
        target = np.stack([(column - u) / fx, (row - v) / fy]).astype(np.float64)
        point, step = target.copy(), 1e-6
        for _ in range(8):
            here = self._distort(point)
            along_x = (self._distort(point + np.array([step, 0.0])[:, None, None]) - here) / step
            along_y = (self._distort(point + np.array([0.0, step])[:, None, None]) - here) / step
            miss = target - here
            determinant = along_x[0] * along_y[1] - along_x[1] * along_y[0]
            point[0] += (miss[0] * along_y[1] - miss[1] * along_y[0]) / determinant
            point[1] += (miss[1] * along_x[0] - miss[0] * along_x[1]) / determinant
        return point[0], point[1]

    def rays(self) -> Array:
        """Unit viewing directions (H, W, 3) in the camera frame."""
        return directions(*self.slopes())

    def _distort(self, point: Array) -> Array:
        x, y = point
        k1, k2, p1, p2, k3 = self.distortion
        square = x * x + y * y
        radial = 1 + square * (k1 + square * (k2 + square * k3))
        across = x * radial + 2 * p1 * x * y + p2 * (square + 2 * x * x)
        return np.stack([across, y * radial + p1 * (square + 2 * y * y) + 2 * p2 * x * y])


def directions(x: Array, y: Array) -> Array:
    """Unit vectors (H, W, 3) of slopes x/z and y/z."""
    rays = np.stack([x, y, np.ones_like(x)], axis=-1)
    return rays / np.linalg.norm(rays, axis=-1, keepdims=True)
