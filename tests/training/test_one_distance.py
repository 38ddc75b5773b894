"""Poses at one distance from a wall of unknown place: nothing tells a scale of the distances.

Shorter distances have less noise, so that the least loss takes every point to the camera. Such a
run ended in a traceback, or was `usable` with distances at half of what they were.
"""

from pathlib import Path

import cameras
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from training.trained import CONFIG

import tofcorr
from tofcorr.data.table import FrameRow
from tofcorr.geometry.rays import ray_directions

CAMERA = cameras.camera((32, 24), (30.0, 30.0), (15.5, 11.5))
WALL = 0.9
"""Distance of the wall from the tool in every frame, metres."""


def _recording(folder: Path, frames: int, spread: float) -> Path:
    """Write frames of a camera that reads 15 mm and 1 % too far, with 2 mm of noise.

    Args:
        folder: To write.
        frames: How many.
        spread: Largest change of the tool's distance to the wall, metres.
    """
    generator = np.random.default_rng(11)
    rays, tool_from_camera = ray_directions(CAMERA).numpy(), np.eye(4)
    tool_from_camera[:3, 3] = 0.05, -0.03, 0.1
    with tofcorr.RecordingWriter(
        folder, camera=CAMERA, depth_kind="radial", modulation_frequency=None, planes="estimated"
    ) as writer:
        for number in range(frames):
            pose = np.eye(4)
            across, down, roll = generator.uniform((-0.5, -0.5, -1.5), (0.5, 0.5, 1.5))
            pose[:3, :3] = Rotation.from_euler("XYZ", (down, across, roll)).as_matrix()
            pose[:2, 3] = generator.uniform(-0.3, 0.3, 2)
            pose[2, 3] = generator.uniform(-spread, spread)
            camera = pose @ tool_from_camera
            facing = rays @ camera[2, :3]
            distance = (WALL - camera[2, 3]) / facing
            noise = 2e-3 * generator.standard_normal(distance.shape)
            plane = {"normal_world": np.array([0.0, 0.0, -1.0]), "offset": WALL, "target": "white"}
            row = FrameRow(timestamp=float(number), world_from_tool=pose, **plane)
            read = (0.015 + 1.01 * distance + noise).astype(np.float32)
            amplitude = (500 * facing / distance**2).astype(np.float32)
            writer.append(read, row=row, amplitude=amplitude)
    return folder


@pytest.mark.parametrize(("frames", "spread"), [(6, 0.0), (24, 0.0), (24, 2e-3)])
def test_distances_that_the_fit_took_away_are_not_used(
    tmp_path: Path, frames: int, spread: float
) -> None:
    wall = _recording(tmp_path / "wall", frames, spread)
    result = tofcorr.train(wall, CONFIG | {"advice": 0}, out=tmp_path / "run")
    assert result.report["verdict"] == "do not use"
    assert "Where 1 m is measured, the fit leaves 0." in result.report["reason"]
    assert not (tmp_path / "run" / "corrector.ts").exists()


def test_poses_near_and_far_keep_the_distances(tmp_path: Path) -> None:
    wall = _recording(tmp_path / "wall", 24, 0.25)
    result = tofcorr.train(wall, CONFIG | {"advice": 0})
    assert result.report["verdict"] != "do not use"
    # The camera's distances grow by 1 %, which the correction takes off.
    assert result.fit.gain == pytest.approx(1 / 1.01, abs=0.01)
