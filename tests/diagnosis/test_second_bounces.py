"""What `degrade` adds, `diagnose` finds: second bounces between a wall and a floor."""

import math
from pathlib import Path

import numpy as np
import pytest
import torch

import tofcorr
from tofcorr.data.table import FrameRow
from tofcorr.geometry import se3
from tofcorr.geometry.camera import CameraIntrinsics
from tofcorr.geometry.rays import ray_directions
from tofcorr.options import resolve_options
from tofcorr.sensor.sensor_file import SensorFile

CAMERA = CameraIntrinsics(
    width=40, height=30, matrix=((34.0, 0.0, 19.5), (0.0, 34.0, 14.5), (0.0, 0.0, 1.0))
)
WALL, FLOOR = ((0.0, 0.0, -1.0), 2.0), ((0.0, -1.0, 0.0), 0.7)
"""Planes n . p + d = 0: 2 m ahead, and 0.7 m below the middle."""
WHITE, REFLECTIVITY, REACH = 4000.0, 0.7, 45.0


def ideal(folder: Path, poses: int = 40) -> Path:
    """Write ideal frames of a robot before the wall; of many the image shows no floor."""
    generator, rays = torch.Generator().manual_seed(5), ray_directions(CAMERA)
    normal = torch.tensor([WALL[0], FLOOR[0]]).double()
    offset = torch.tensor([WALL[1], FLOOR[1]]).double()
    with tofcorr.RecordingWriter(
        folder, camera=CAMERA, depth_kind="radial", modulation_frequency=20e6
    ) as writer:
        for number in range(poses):
            drawn = 2 * torch.rand(6, generator=generator).double() - 1
            size = torch.tensor([0.5, 0.35, 0.7, 0.5, 0.4, 1.0]).double()
            pose = se3.exp(drawn * size)
            ray = rays @ pose[:3, :3].T
            cosine = -(ray @ normal.T)
            each = (normal @ pose[:3, 3] + offset) / cosine
            distance, plane = torch.where(cosine > 0, each, math.inf).min(-1)
            slant = cosine.gather(-1, plane[..., None])[..., 0]
            writer.append(
                distance.float().numpy(),
                amplitude=(WHITE * REFLECTIVITY * slant / distance**2).float().numpy(),
                mask=(plane == 0).numpy().astype(np.uint8),
                row=FrameRow(
                    timestamp=3.0 * number,
                    world_from_tool=pose.numpy(),
                    normal_world=np.array(WALL[0]),
                    offset=WALL[1],
                    target="wall",
                ),
            )
    return folder


@pytest.mark.slow
def test_second_bounces_that_degrade_adds_are_named_with_their_gain(tmp_path: Path) -> None:
    gain = 1 / (math.pi * WHITE)
    sensor = resolve_options(
        SensorFile,
        {
            "format": "tofcorr-sensor",
            "version": 1,
            "camera": CAMERA.section(),
            "depth_kind": "radial",
            "modulation_frequency_hz": 20e6,
            "noise": {"floor_m": 0.002},
            "validity": {"radial_distance_m": [0.5, 5.0]},
            "second_bounces": {
                "frequencies_hz": [20e6],
                "gain": gain,
                "light_half_angle_deg": REACH,
            },
        },
    )
    frames = tofcorr.degrade(sensor, ideal(tmp_path / "ideal"), tmp_path / "frames").recording
    report = tmp_path / "report"
    found = tofcorr.diagnose(frames, out=report, config={"page": False})
    assert found.effects[0] == "multipath"
    assert "second bounces of light by a plane in view" in found.details
    assert found.second_bounces is not None
    low, high = found.second_bounces.gain_interval or (0.0, 0.0)
    assert low < found.second_bounces.gain < high
    # Calibration absorbs a part of them, and the cone of light is one of three.
    assert 0.4 < found.second_bounces.gain / gain < 1.25
    assert tofcorr.SensorModel.load(report).sensor.second_bounces == found.second_bounces
    before, after = found.stages[1].gap, found.stages[2].gap
    assert found.degraded is not None
    assert before is not None
    assert after is not None
    assert after < 0.5 * before
    assert found.degraded.gap < before
    trained = tofcorr.train_with(report, frames)
    assert trained.options.runtime.second_bounces is not None
    assert trained.options.runtime.second_bounces.gain == found.second_bounces.gain
