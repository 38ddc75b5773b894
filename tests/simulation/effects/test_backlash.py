"""A robot with play stays behind, on the side from which it came."""

from dataclasses import replace

import torch

from tofcorr.simulation.effects.base import EffectInputs
from tofcorr.simulation.effects.robot_kinematics import BacklashEffect, sides_of_approach


def test_an_arm_from_the_other_side_stops_farther_by_the_play(inputs: EffectInputs) -> None:
    play = torch.tensor([0.003, -0.002, 0.001], dtype=torch.float64)
    effect = BacklashEffect(BacklashEffect.shape_type(), play / 2)
    sides = [torch.full((4, 3), side, dtype=torch.float64) for side in (-1.0, 1.0)]
    facts = [replace(inputs.facts, approach=side) for side in sides]
    reached = [replace(inputs, facts=one) for one in facts]
    below, above = (effect.shift(one, effect.coefficients) for one in reached)
    camera = (inputs.facts.world_from_tool @ inputs.tool_from_camera)[inputs.frame, :3, :3]
    rays = (camera @ inputs.rays[:, :, None])[..., 0]
    normal = inputs.facts.normal_world[inputs.frame]
    expected = -(normal @ play) / (normal * rays).sum(1)
    torch.testing.assert_close(above - below, expected, atol=1e-12, rtol=0.0)


def test_a_repeat_keeps_the_side_from_which_its_pose_was_reached() -> None:
    poses = torch.eye(4, dtype=torch.float64).repeat(5, 1, 1)
    poses[:, 0, 3] = torch.tensor([0.0, 0.1, 0.1, 0.05, 0.05])
    poses[:, 1, 3] = torch.tensor([0.0, 0.0, -0.2, -0.2, -0.2])
    expected = [[0, 0, 0], [1, 0, 0], [1, -1, 0], [-1, -1, 0], [-1, -1, 0]]
    assert sides_of_approach(poses).tolist() == expected
