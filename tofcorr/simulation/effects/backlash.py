"""Play in the gears of a robot: it stays behind, on the side from which it came."""

from dataclasses import replace

import torch
from torch import Tensor

from tofcorr.geometry import se3
from tofcorr.simulation.effects.base import Coefficient, GeometryEffect
from tofcorr.simulation.effects.inputs import ROBOT, FrameFacts

# A motion along an axis below this length, metres, turns no gear over: the side stays. Chosen:
# above what the encoders of a robot at rest report, below the play that matters.
_LEAST_MOVE = 1e-4


class BacklashEffect(GeometryEffect):
    r"""A position that depends on the side from which the tool came.

    .. math:: p' = p + \operatorname{diag}(b)\, u

    u holds the signs of the tool's last motion along the axes of the world (`sides_of_approach`).
    Each joint has a play of its own; over the poses of a recording most of it is a shift along the
    axes.
    """

    name = "backlash"
    summary = "play in the gears of the robot"
    source = "ISO 9283, unidirectional against multi-directional pose accuracy"
    remedy = "the same poses, approached from the other side"
    needs = (ROBOT,)
    moves_images = True
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
    turned = moved.abs() > _LEAST_MOVE
    number = torch.arange(len(moved), device=moved.device)[:, None]
    last = torch.where(turned, number, 0).cummax(0).values
    return torch.where(turned, moved.sign(), 0.0).gather(0, last)
