"""The PyBullet example renders what the scene holds, and the sensor degrades it."""

import numpy as np
import pytest
import torch
from examples.stand_ins import load_example

import tofcorr


def test_a_box_on_a_floor_is_rendered_in_metres_and_measured() -> None:
    pytest.importorskip("pybullet", reason="PyBullet is not installed: pip install pybullet")
    example = load_example("pybullet_depth")
    sensor = tofcorr.SensorModel.load("kinect_v2")
    camera = sensor.sensor.intrinsics()
    depth, albedo = example.box_on_floor(camera.width, camera.height, camera.matrix[0][0])
    # The floor on the optical axis, by hand: 0.75 - z (0.6 / |gaze|) = 0 along the gaze, if the box
    # were not there; the box stands in front of it.
    gaze = np.linalg.norm([0.85, -0.5, 0.6])
    middle = float(depth[camera.height // 2, camera.width // 2])
    assert gaze - 0.3 < middle < gaze
    assert float(albedo[camera.height // 2, camera.width // 2]) == pytest.approx(0.7)
    with torch.no_grad():
        measured = sensor(depth, reflectivity=albedo, generator=torch.Generator().manual_seed(2))
    assert bool(measured.depth[depth.isnan()].isnan().all())
    error = (measured.depth - depth)[measured.valid]
    assert 0.005 < float(error.mean()) < 0.04


def test_the_tiny_renderer_looks_where_the_page_says() -> None:
    """Half a pixel to the left and half a pixel below where other renderers look: 8.6 mm."""
    pybullet = pytest.importorskip("pybullet", reason="PyBullet is not installed")
    client, (height, width), focal = pybullet.connect(pybullet.DIRECT), (50, 64), 54.0
    shape = pybullet.createCollisionShape(pybullet.GEOM_BOX, halfExtents=[5, 5, 1])
    turn = pybullet.getQuaternionFromEuler([0.4, -0.3, 0.2])
    normal = np.reshape(pybullet.getMatrixFromQuaternion(turn), (3, 3))[:, 2]
    pybullet.createMultiBody(0, shape, basePosition=-normal, baseOrientation=turn)
    view = pybullet.computeViewMatrix([0, 0, 2], [0, 0, 0], [0, 1, 0])
    field = np.degrees(2 * np.arctan(height / (2 * focal)))
    lens = pybullet.computeProjectionMatrixFOV(field, width / height, 0.5, 8.0)
    tiny = pybullet.ER_TINY_RENDERER
    buffer = pybullet.getCameraImage(width, height, view, lens, renderer=tiny)[3]
    pybullet.disconnect(client)
    depth = 8.0 * 0.5 / (8.0 - 7.5 * np.reshape(buffer, (height, width)))
    row, column = np.mgrid[:height, :width]
    # The wall passes through the origin, 2 m before the camera, which looks down.
    x, y = (column - width / 2) / focal, -(row - (height / 2 - 1)) / focal
    wall = 2 * normal[2] / (normal[2] - normal[0] * x - normal[1] * y)
    np.testing.assert_allclose(depth, wall, atol=1e-4)
