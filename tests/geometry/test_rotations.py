"""Quaternions and rotation vectors agree with SciPy, at every angle."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tofcorr.geometry.rotations import quaternion_from_matrix, rotation_vector_from_matrix


@pytest.mark.parametrize("angle", [0.0, 1e-12, 1e-5, 0.3, 2.0, np.pi - 1e-7, np.pi])
def test_they_agree_with_scipy_at_every_angle(angle: float) -> None:
    axes = np.random.default_rng(7).normal(size=(12, 3))
    axes = np.concatenate([axes / np.linalg.norm(axes, axis=1, keepdims=True), np.eye(3)])
    for axis in axes:
        turned = Rotation.from_rotvec(angle * axis)
        matrix = turned.as_matrix()
        np.testing.assert_allclose(
            quaternion_from_matrix(matrix), Rotation.from_matrix(matrix).as_quat(), atol=1e-15
        )
        vector = rotation_vector_from_matrix(matrix)
        np.testing.assert_allclose(Rotation.from_rotvec(vector).as_matrix(), matrix, atol=1e-15)
        assert np.linalg.norm(vector) == pytest.approx(angle, abs=1e-15, rel=1e-7)
