"""A time difference between images and poses."""

import torch
from torch import Tensor

from tofcorr.geometry import se3
from tofcorr.geometry.planes import distance_along_rays
from tofcorr.options import Options
from tofcorr.simulation.effects.base import CatalogueEffect, Coefficient
from tofcorr.simulation.effects.inputs import EffectInputs
from tofcorr.simulation.effects.needs import VELOCITY
from tofcorr.simulation.hooks import FrameState


class TimestampOffsetEffect(CatalogueEffect):
    r"""The image is taken `offset_s` after the recorded pose.

    .. math:: T' = T \exp(\hat\xi\, \Delta t)

    for the twist xi of the tool.
    """

    name = "timestamp_offset"
    summary = "a time difference between images and poses"
    source = "rigid motion at constant twist"
    remedy = "the same path in both directions, or poses at rest"
    needs = (VELOCITY,)

    @classmethod
    def terms(cls, shape: Options) -> tuple[Coefficient, ...]:
        """Return the delay of the images."""
        del shape
        return (Coefficient("offset_s", "s", 0.2),)

    def shift(self, inputs: EffectInputs, coefficients: Tensor) -> Tensor:
        """Return how much farther the target is at the time of the image, shape (M,), metres."""
        facts = inputs.facts
        if facts.tool_twist is None:
            raise ValueError("The tool's velocity is unknown; timestamp_offset needs it.")
        plane = (facts.normal_world, facts.offset)
        recorded = facts.world_from_tool @ inputs.tool_from_camera
        later = _later(facts.world_from_tool, facts.tool_twist * coefficients[0])
        true = later @ inputs.tool_from_camera
        return distance_along_rays(inputs.rays, inputs.frame, true, *plane) - distance_along_rays(
            inputs.rays, inputs.frame, recorded, *plane
        )

    def on_pose(self, state: FrameState) -> None:
        """Move the tool to its pose at the time of the image."""
        if state.tool_twist is None or self.coefficients[0] == 0:
            return
        twist = state.tool_twist[None] * self.coefficients[0]
        state.world_from_tool = _later(state.world_from_tool[None], twist)[0]


def _later(world_from_tool: Tensor, twist: Tensor) -> Tensor:
    """Move poses (F, 4, 4) by twists (F, 6), to second order: exact to 1e-6 m at 10 cm."""
    zero = torch.zeros_like(twist[:, 0])
    x, y, z = twist[:, 3:].unbind(1)
    skew = torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], dim=1).reshape(-1, 3, 3)
    step = torch.eye(3, dtype=twist.dtype) + skew + skew @ skew / 2
    shift = twist[:, :3] + (skew @ twist[:, :3, None])[..., 0] / 2
    return world_from_tool @ se3.assemble(step, shift)
