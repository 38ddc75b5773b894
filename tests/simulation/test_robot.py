"""Poses before the wall."""

import math

import pytest
import torch
from optional import present
from simulation.small import expected_frames, planned, small
from torch import Generator

from tofcorr.errors import ConfigError
from tofcorr.geometry import se3
from tofcorr.geometry.rays import plane_in_frame
from tofcorr.geometry.se3 import tool_twists
from tofcorr.simulation.options import ArmOptions, CameraMountOptions, MountGuessOptions
from tofcorr.simulation.robot import hand_eye_guess


def test_wall_fills_every_frame_within_the_limits() -> None:
    robot = {"tilt_deg": 45.0, "farthest_pixel_m": 2.0, "steepest_incidence_deg": 70.0}
    options = small(shots=[{"target": "white", "poses": 25}], robot=robot)
    for state in expected_frames(options):
        assert state.radial_distance.isfinite().all()
        assert state.radial_distance.max() <= 2.0
        assert state.incidence_cosine.min() >= math.cos(math.radians(70.0)) - 1e-12


def test_distance_along_the_optical_axis_is_within_its_bounds() -> None:
    scene = {"plane": {"normal": [0.6, 0.0, 0.8], "offset_m": -2.0}}
    shots = [{"target": "white", "poses": 25}]
    options = small(shots=shots, robot={"distance_m": [0.7, 0.9]}, scene=scene)
    for frame in planned(options):
        camera = frame.facts.world_from_tool[-1] @ options.hand_eye.tool_from_camera()
        normal, offset = plane_in_frame(*options.scene.plane.tensors(), camera)
        assert 0.7 <= -offset / normal[2] <= 0.9


@pytest.mark.parametrize(
    ("axes", "tilted"),
    [("none", (False, False)), ("x", (False, True)), ("y", (True, False)), ("both", (True, True))],
)
def test_tilt_is_restricted_to_its_axes(axes: str, tilted: tuple[bool, bool]) -> None:
    options = small(robot={"tilt_axes": axes})
    axis = planned(options)[-1].facts.world_from_tool
    optical = (axis @ options.hand_eye.tool_from_camera())[:, :3, 2]
    # The wall is z = 0: tilt about x moves the optical axis along y, and the other way round.
    leans = tuple(bool((optical[:, k].abs() > 1e-9).any()) for k in range(2))
    assert leans == tilted


def test_robot_reaches_poses_within_its_repeatability() -> None:
    robot = {"repeatability_mm": 0.4, "repeatability_mrad": 0.7}
    options = small(shots=[{"target": "white", "poses": 300}], robot=robot)
    frames = planned(options)
    recorded = frames[-1].facts.world_from_tool
    reached = torch.stack([f.world_from_tool for f in frames])
    missed = se3.log(se3.inverse(recorded) @ reached)
    assert missed[:, :3].std().item() == pytest.approx(0.4e-3, rel=0.1)
    assert missed[:, 3:].std().item() == pytest.approx(0.7e-3, rel=0.1)


def test_repeated_frames_share_their_pose() -> None:
    conditions = {"integration_time_us": [250.0, 500.0, 1000.0], "ambient_counts": [10, 20]}
    repeats = {"repeat_poses": 2, "repeat_frames": 4}
    frames = planned(small(robot=repeats, conditions=conditions))
    assert [f.pose_id for f in frames] == [0] * 4 + [1] * 4 + [2, 3, 4, 5, 6]
    for frame in frames[1:4]:
        assert torch.equal(frame.world_from_tool, frames[0].world_from_tool)
        assert frame.recorded("integration_time") == frames[0].recorded("integration_time")
    assert bool((frames[-1].facts.timestamp.diff() > 0).all())


def test_sweep_goes_away_from_the_wall() -> None:
    options = small(robot={"order": "by_distance", "tilt_axes": "none"})
    nearest = [state.radial_distance.min().item() for state in expected_frames(options)]
    assert nearest == sorted(nearest)


def test_guess_is_as_far_from_the_truth_as_asked(generator: Generator) -> None:
    asked = MountGuessOptions(translation_mm=30.0, rotation_deg=5.0)
    truth = CameraMountOptions().tool_from_camera()
    guess = hand_eye_guess(CameraMountOptions(guess=asked), generator)
    assert (guess - truth)[:3, 3].norm().item() == pytest.approx(0.030)
    turn = se3.rotation_angle(guess[:3, :3].T @ truth[:3, :3])
    assert math.degrees(turn.item()) == pytest.approx(5.0)


def test_speed_on_a_path_agrees_with_the_poses_before_and_after() -> None:
    robot = {"motion": "continuous", "roll_deg": 30.0, "tilt_deg": 20.0}
    robot |= {"repeatability_mm": 0.0, "repeatability_mrad": 0.0, "waypoint_every_frames": 20}
    shots, conditions = [{"target": "white", "poses": 40}], {"frame_interval_s": 0.1}
    frames = planned(small(shots=shots, robot=robot, conditions=conditions))
    facts = frames[-1].facts
    truth = present(facts.tool_twist)
    error = (tool_twists(facts.timestamp, facts.world_from_tool) - truth).abs() / truth.abs().max()
    # Parabolas over 0.2 s of a path bent within seconds; at its ends they look to one side.
    assert error[1:-1].max() < 0.05
    assert error.max() < 0.1
    assert all(f.pose_id is None for f in frames)


def test_speed_is_unknown_across_long_gaps() -> None:
    poses = torch.eye(4, dtype=torch.float64).expand(5, 4, 4)
    times = torch.tensor([0.0, 0.1, 0.2, 5.0, 5.1], dtype=torch.float64)
    known = ~tool_twists(times, poses).isnan().any(-1)
    assert known.tolist() == [True, True, True, False, False]


def test_an_arm_reports_its_description_at_the_angles_and_reaches_them_with_offsets() -> None:
    exact = {"repeatability_mm": 0, "repeatability_mrad": 0, "distance_m": [0.5, 1.1]}
    offsets, shots = (0.2, -0.3, 0.1), [{"target": "white", "poses": 6}]
    scene = {"plane": {"normal": [-1, 0, 0], "offset_m": 1.3}}
    robot = exact | {"arm": {"offsets_deg": offsets}}
    state = planned(small(shots=shots, robot=robot, scene=scene))[-1]
    angles, arm = present(state.facts.joint_angles), ArmOptions().arm()
    assert torch.allclose(arm.poses(angles), state.facts.world_from_tool, atol=1e-12)
    true = angles[-1:] + torch.deg2rad(torch.tensor([*offsets, 0, 0, 0], dtype=torch.float64))
    assert torch.allclose(arm.poses(true)[0], state.world_from_tool, atol=1e-12)
    scene["plane"]["offset_m"] = 9.0
    with pytest.raises(ConfigError, match="it does not reach the poses before the wall"):
        planned(small(shots=shots, robot=robot, scene=scene))
