"""Rays, motions and four samples of the second generator, by hand or by another program."""

import numpy as np
import pytest

from benchmarks.withheld.generator.camera import Camera, draw_camera
from benchmarks.withheld.generator.observe import demodulate
from benchmarks.withheld.generator.rigid import inverse, quaternions, rotations, small_motions


def test_four_samples_by_hand() -> None:
    # phase 90 degrees, amplitude 2, mean 5: A_k = 5 + 2 cos(90 + 90 k)
    taps = np.array([5.0, 3.0, 5.0, 7.0]).reshape(4, 1, 1, 1)
    distance, amplitude = demodulate(taps, 8.0)
    assert distance.item() == pytest.approx(2.0)
    assert amplitude.item() == pytest.approx(2.0)


@pytest.mark.parametrize("frequency", [24e6, 30e6])
def test_rays_project_back_to_their_pixels(frequency: float) -> None:
    rng = np.random.default_rng(3)
    camera = draw_camera(rng)
    while camera.modulation_frequency != frequency:
        camera = draw_camera(rng)
    cv2 = pytest.importorskip("cv2", reason="OpenCV's projection is the independent check")
    projected, _ = cv2.projectPoints(
        camera.rays().reshape(-1, 3),
        np.zeros(3),
        np.zeros(3),
        np.array(camera.matrix),
        np.array(camera.distortion),
    )
    column, row = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
    expected = np.stack([column, row], -1).reshape(-1, 2)
    np.testing.assert_allclose(projected[:, 0], expected, atol=1e-6)


def test_quaternions_turn_vectors_as_their_rotations() -> None:
    vectors = np.random.default_rng(0).normal(0, 2, (50, 3))
    matrices = rotations(vectors)
    x, y, z, w = quaternions(matrices).T
    point = np.array([0.3, -0.7, 1.1])
    axis = np.stack([x, y, z], -1)
    turned = point + 2 * np.cross(axis, np.cross(axis, point) + w[:, None] * point)
    np.testing.assert_allclose(turned, matrices @ point, atol=1e-12)


def test_inverse_undoes_a_motion() -> None:
    motion = small_motions(np.array([[0.1, 0.2, 0.3]]), np.array([[0.5, -1.0, 2.0]]))
    np.testing.assert_allclose(motion @ inverse(motion), np.eye(4)[None], atol=1e-14)


def test_camera_of_no_distortion_has_pinhole_rays() -> None:
    camera = Camera(5, 3, (10.0, 10.0), (2.0, 1.0), (0.0, 0.0, 0.0, 0.0, 0.0), 2e7, 1.0, 1.0)
    x, y = camera.slopes()
    np.testing.assert_allclose(x[0], [-0.2, -0.1, 0.0, 0.1, 0.2])
    np.testing.assert_allclose(y[:, 0], [-0.1, 0.0, 0.1])
