"""Errors of the poses that the robot reports: of its geometry, and by the play of its gears."""

from dataclasses import replace
from typing import Self

import torch
from torch import Tensor

from tofcorr.data.recording import STANDSTILL
from tofcorr.geometry import se3
from tofcorr.geometry.se3 import small_motion
from tofcorr.options import Options
from tofcorr.simulation.effects.base import ROBOT, Coefficient, EffectInputs, GeometryEffect
from tofcorr.simulation.hooks import FrameFacts

_AXES = "xyz"
_PAIRS = tuple(f"{i}{j}" for i in _AXES for j in _AXES)
_BASE = ("cos_1", "sin_1", "cos_2", "sin_2", "cos_3", "sin_3")


class RobotKinematicsShape(Options):
    """The position of the tool without error."""

    centre_m: tuple[float, float, float] = (0.0, 0.0, 1.0)


class RobotKinematicsEffect(GeometryEffect, shape=RobotKinematicsShape):
    r"""A pose error that depends on position and orientation of the tool.

    .. math:: p' = (1 + l)\, p + M q + s |q|^2, \quad
              R' = \exp([W q]_\times)\, R \exp([b \times g]_\times), \quad q = p - p_0

    M contains scale and skew of the axes (link lengths), s the sag of the stretched arm, W the
    rotation of the tool with its position (joint offsets). b bends the camera's bracket under its
    weight: g is the unit vector downwards, -z in the world, in the frame of the tool. If the origin
    of the world is the base of the robot, l is the share by which all its distances are too short
    (a wrong unit, a wrong arm), and the whole arm also rotates about it: about the vertical axis by
    a_k cos(k alpha) + b_k sin(k alpha), k = 1, 2, 3, for the azimuth alpha (eccentric encoder,
    gear), and downwards by d rho^2 for the reach rho (bending base).

    Source: linearised kinematic error of a serial arm (Mooring, Roth and Driels 1991).
    """

    name = "robot_kinematics"
    summary = "scale, sag or joint errors of the robot, or a bracket that bends"
    remedy = "the same camera poses by another configuration of the arm, or a tracker"
    needs = (ROBOT,)
    fixed_terms = (
        *(Coefficient(f"scale_{pair}", "m/m", 0.004) for pair in _PAIRS),
        *(Coefficient(f"sag_{i}", "m/m^2", 0.004) for i in _AXES),
        *(Coefficient(f"turn_{pair}", "rad/m", 0.004) for pair in _PAIRS),
        *(Coefficient(f"base_{part}", "rad", 0.002) for part in _BASE),
        Coefficient("base_droop", "rad/m^2", 0.004),
        Coefficient("length", "m/m", 0.01),
        *(Coefficient(f"bracket_{i}", "rad", 0.004) for i in _AXES),
    )

    @classmethod
    def for_recording(cls, inputs: EffectInputs) -> Self:
        """Take the mean position of the tool as reference."""
        centre = inputs.facts.world_from_tool[:, :3, 3].mean(0).tolist()
        return cls(RobotKinematicsShape(centre_m=(centre[0], centre[1], centre[2])))

    def moved(self, facts: FrameFacts, coefficients: Tensor) -> FrameFacts:
        """Return where the tool truly is."""
        c, pose = coefficients, facts.world_from_tool
        rotation, position = pose[:, :3, :3], pose[:, :3, 3]
        away = position - position.new_tensor(self.shape.centre_m)
        base = _base_turn(position, c[21:28])
        shift = away @ c[:9].reshape(3, 3).T + away.square().sum(1, keepdim=True) * c[9:12]
        shift = shift + torch.linalg.cross(base, position) + c[28] * position
        turn = away @ c[12:21].reshape(3, 3).T + base + _bracket_turn(rotation, c[29:32])
        turned = small_motion(torch.cat([torch.zeros_like(turn), turn], dim=1))[:, :3, :3]
        true = se3.assemble(turned @ rotation, position + shift)
        return replace(facts, world_from_tool=true)


def _base_turn(position: Tensor, c: Tensor) -> Tensor:
    """Return the rotation vector of the arm about the origin, shape (F, 3), radians."""
    x, y = position[:, 0], position[:, 1]
    azimuth, square = torch.atan2(y, x), x**2 + y**2
    waves = [wave(k * azimuth) for k in (1, 2, 3) for wave in (torch.cos, torch.sin)]
    upright = torch.stack(waves, dim=-1) @ c[:6]
    droop = c[6] * square.sqrt()
    return torch.stack([-droop * y, droop * x, upright], dim=-1)


def _bracket_turn(rotation: Tensor, c: Tensor) -> Tensor:
    """Return the rotation vector of the bracket in the world, shape (F, 3), radians.

    It gives way alike in all directions, so that its turn is about the torque of the weight.
    """
    down = -rotation[:, 2, :]  # In the frame of the tool.
    turn = torch.linalg.cross(c.expand_as(down), down)
    return (rotation @ turn[:, :, None])[:, :, 0]


class BacklashEffect(GeometryEffect):
    r"""A position that depends on the side from which the tool came.

    .. math:: p' = p + \operatorname{diag}(b)\, u

    u holds the signs of the tool's last motion along the axes of the world (`sides_of_approach`).
    Each joint has a play of its own; over the poses of a recording most of it is a shift along the
    axes.

    Source: ISO 9283, unidirectional against multi-directional pose accuracy.
    """

    name = "backlash"
    summary = "play in the gears of the robot"
    remedy = "the same poses, approached from the other side"
    needs = (ROBOT,)
    fixed_terms = tuple(Coefficient(f"play_{axis}", "m", 0.002) for axis in "xyz")

    def moved(self, facts: FrameFacts, coefficients: Tensor) -> FrameFacts:
        """Shift each pose to the side from which the tool came."""
        if facts.approach is None:
            return facts
        pose = facts.world_from_tool
        position = pose[:, :3, 3] + facts.approach * coefficients
        return replace(facts, world_from_tool=se3.assemble(pose[:, :3, :3], position))


def sides_of_approach(world_from_tool: Tensor) -> Tensor:
    """Return the sign of the tool's last motion along each axis of the world, shape (N, 3).

    Zero where the tool has not moved along that axis yet.

    Args:
        world_from_tool: Poses in the order in which they were reached, shape (N, 4, 4).
    """
    position = world_from_tool[:, :3, 3]
    moved = torch.zeros_like(position)
    moved[1:] = position.diff(dim=0)
    turned = moved.abs() > STANDSTILL  # Less turns no gear over: the side stays.
    number = torch.arange(len(moved), device=moved.device)[:, None]
    last = torch.where(turned, number, 0).cummax(0).values
    return torch.where(turned, moved.sign(), 0.0).gather(0, last)
