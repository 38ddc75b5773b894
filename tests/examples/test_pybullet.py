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
