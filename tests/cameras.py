"""Cameras of the tests, their places, and how far these are apart."""

from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from tofcorr.geometry.camera import CameraIntrinsics


def camera(
    size: tuple[int, int],
    focal: tuple[float, float],
    centre: tuple[float, float],
    *distortion: float,
) -> CameraIntrinsics:
    """Return a camera of a size (width, height), focal lengths and a principal point in pixels."""
    matrix = ((focal[0], 0.0, centre[0]), (0.0, focal[1], centre[1]), (0.0, 0.0, 1.0))
    return CameraIntrinsics(width=size[0], height=size[1], matrix=matrix, distortion=distortion)


def rigid(turn: Rotation, place: Any) -> np.ndarray:
    """Return the transform (..., 4, 4) that turns and then moves by `place` (..., 3)."""
    matrix = turn.as_matrix()
    transform = np.tile(np.eye(4), (*matrix.shape[:-2], 1, 1))
    transform[..., :3, :3], transform[..., :3, 3] = matrix, place
    return transform


def apart(first: Any, second: Any) -> np.ndarray:
    """Return how far two transforms (4, 4) are apart: millimetres and degrees."""
    between = np.linalg.inv(np.asarray(first)) @ np.asarray(second)
    turn = Rotation.from_matrix(between[:3, :3]).magnitude()
    return np.array([1e3 * np.linalg.norm(between[:3, 3]), np.degrees(turn)])
