"""Poses planned before any recording calibrate a camera as well as they promise."""

import csv
import itertools
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from running import Program
from scipy.spatial.transform import Rotation
from simulated_walls import EA, fitted, taken, wall_options

from tofcorr.errors import ConfigError
from tofcorr.geometry import se3
from tofcorr.geometry.rays import tangents
from tofcorr.training.advice import PosePlan, Workspace, plan_poses

SMALL = wall_options(1).camera.intrinsics()
SPACE = Workspace(nearest=0.5, farthest=1.5)


@pytest.fixture(scope="module")
def plan() -> PosePlan:
    return plan_poses(SMALL, EA, SPACE, number=12)


def test_views_stay_in_the_workspace_and_on_one_point_of_the_wall(plan: PosePlan) -> None:
    for pose, (distance, tilt, _) in zip(plan.start_from_tool, plan.described, strict=True):
        assert 0.5 <= distance <= 1.5
        assert tilt <= 35.0
        # The wall is z = 1, the middle of the distances, in the axes of the start pose.
        looked_at = pose[:3, 3] + distance * pose[:3, 2]
        torch.testing.assert_close(looked_at, torch.tensor([0.0, 0.0, 1.0]).double())
        assert math.degrees(math.acos(float(pose[2, 2]))) == pytest.approx(float(tilt), abs=1e-6)


def test_each_further_pose_lowers_the_expected_errors_and_few_determine_nothing(
    plan: PosePlan,
) -> None:
    sizes = plan.expected[:, 0].tolist()
    assert math.isinf(sizes[0])
    assert math.isfinite(sizes[-1])
    assert all(later <= earlier * (1 + 1e-9) for earlier, later in itertools.pairwise(sizes))
    assert "not determined" not in repr(plan).splitlines()[-1]


def test_a_guess_of_the_hand_eye_moves_the_tool_and_not_the_camera(plan: PosePlan) -> None:
    guess = np.eye(4)
    guess[:3, :3] = Rotation.from_euler("xyz", (10, -20, 90), degrees=True).as_matrix()
    guess[:3, 3] = (0.05, 0.0, 0.12)
    other = plan_poses(SMALL, EA, SPACE, number=3, tool_from_camera=guess)
    hand_eye = torch.from_numpy(guess)
    # start_from_tool @ tool_from_camera is the camera in the tool's start; so is hand_eye @ view.
    cameras = torch.linalg.inv(hand_eye) @ other.start_from_tool @ hand_eye
    torch.testing.assert_close(cameras, plan.start_from_tool[:3], rtol=0, atol=1e-9)


def test_a_wall_of_limited_size_keeps_every_corner_of_the_view() -> None:
    wall = replace(SPACE, wall_size=(1.2, 1.0))
    found = plan_poses(SMALL, EA, wall, number=8)
    assert float(found.described[:, 0].max()) < 1.5
    with pytest.raises(ConfigError, match="No view lies on the wall"):
        plan_poses(SMALL, EA, replace(SPACE, wall_size=(0.2, 0.2)))


@pytest.mark.parametrize(
    ("nearest", "farthest", "tilt"), [(0.0, 1.0, 30.0), (1.5, 0.5, 30.0), (0.5, 1.5, 80.0)]
)
def test_an_impossible_workspace_is_refused(nearest: float, farthest: float, tilt: float) -> None:
    with pytest.raises(ConfigError, match=r"distances|tilt"):
        Workspace(nearest=nearest, farthest=farthest, tilt_deg=tilt)


def test_a_camera_taken_to_the_planned_poses_is_calibrated_as_promised(
    tmp_path: Path, generator: torch.Generator
) -> None:
    plan = plan_poses(SMALL, EA, replace(SPACE, checkerboard=True), number=24)
    simulator = wall_options(1)
    hand_eye = simulator.hand_eye.tool_from_camera()
    # The plan's tool is the camera; it starts one metre in front of the simulator's wall.
    normal, offset = simulator.scene.plane.tensors()
    x = tangents(normal[None])[0, 0]
    axes = torch.stack([x, torch.linalg.cross(-normal, x), -normal], dim=1)
    start = se3.assemble(axes, (1.0 - offset) * normal)
    poses = start @ plan.start_from_tool @ torch.linalg.inv(hand_eye)
    data = taken(tmp_path / "wall", 1, poses, ["checkerboard"] * 24, generator)
    fit = fitted(data)
    found = fit.solution.parameters.tool_from_camera
    error_mm = 1e3 * float((found - hand_eye)[:3, 3].norm())
    # Three axes, each within three standard errors of the worst.
    assert error_mm < 3 * 3**0.5 * float(plan.expected[-1, 0])


COMMAND = "poses --focal 45 --centre 15.9,11.8 --size 32 25 --distance 0.5 1.5 --number 6 --start"


def test_the_command_writes_poses_of_the_robot(tmp_path: Path, program: Program) -> None:
    start = "0.4,0,0.5,0,0.7071068,0,0.7071068"
    code, told, _ = program(*COMMAND.split(), start, "--out", tmp_path / "poses.csv")
    assert code == 0
    rows = list(csv.DictReader((tmp_path / "poses.csv").read_text().splitlines()))
    assert len(rows) == 6
    for row in rows:
        pose = [float(row[name]) for name in ("tx", "ty", "tz", "qx", "qy", "qz", "qw")]
        forward = Rotation.from_quat(pose[3:]).as_matrix()[:, 2]
        # The start looks along the world's x axis; every pose looks at the same point of the wall.
        looked_at = np.array(pose[:3]) + float(row["distance_m"]) * forward
        np.testing.assert_allclose(looked_at, [1.4, 0.0, 0.5], atol=1e-3)
    assert "6 poses determine the hand-eye transform to" in told


def test_a_start_that_is_no_pose_is_refused(tmp_path: Path, program: Program) -> None:
    code, _, told = program(*COMMAND.split(), "0,0,0,1,1,0,0", "--out", tmp_path / "poses.csv")
    assert code == 2
    assert "--start: the quaternion x y z w has length 1.414" in told
    assert list(tmp_path.iterdir()) == []
