"""A target whose plane differs from the recorded one."""

from typing import ClassVar, Self

import torch
from torch import Tensor

from tofcorr.geometry.planes import distance_along_rays, tangents
from tofcorr.options import Options
from tofcorr.simulation.effects.base import CatalogueEffect, Coefficient
from tofcorr.simulation.effects.inputs import EffectInputs
from tofcorr.simulation.effects.needs import FIXED_TARGET, MEASURED_PLANES
from tofcorr.simulation.hooks import FrameState

# Planes whose entries (n, d) differ by less (no unit, metres) are one plane. Set by hand: far above
# rounding in a file, far below any accuracy of a plane.
_SAME_PLANE = 1e-6
# Largest number of planes with an error of their own. Set by hand: each adds three coefficients.
_MOST_PLANES = 4


class TargetRegistrationShape(Options):
    """The recorded planes (nx, ny, nz, d), and the point about which they tilt."""

    planes: tuple[tuple[float, float, float, float], ...] = ()
    pivot_m: tuple[float, float, float] = (0.0, 0.0, 0.0)


class TargetRegistrationEffect(CatalogueEffect):
    r"""An error of each plane's offset and of the two angles of its normal.

    .. math:: n' = \frac{n + a u + b v}{|n + a u + b v|}, \quad d' = d + \delta - (n' - n) \cdot p

    for unit vectors u and v in the plane and the pivot p. If the shape lists no planes, all planes
    have the same error.
    """

    name = "target_registration"
    summary = "a plane whose position or tilt differs from the recorded one"
    source = "geometry of a plane"
    remedy = "tilts to both sides and a laser or tracker reference of the plane"
    needs = (FIXED_TARGET, MEASURED_PLANES)
    shape_type: ClassVar[type[Options]] = TargetRegistrationShape

    @classmethod
    def for_recording(cls, inputs: EffectInputs) -> Self:
        """Give up to four planes of the recording an error of their own."""
        facts = inputs.facts
        planes = torch.cat([facts.normal_world, facts.offset[:, None]], dim=1)
        unique = torch.unique((planes / _SAME_PLANE).round(), dim=0) * _SAME_PLANE
        listed = tuple(tuple(plane) for plane in unique.tolist()) if len(unique) > 1 else ()
        pivot = tuple(inputs.points_world.mean(0).tolist())
        return cls(TargetRegistrationShape(planes=listed[:_MOST_PLANES], pivot_m=pivot))

    @classmethod
    def terms(cls, shape: TargetRegistrationShape) -> tuple[Coefficient, ...]:
        """Return the errors of offset and two angles for each plane."""
        suffixes = [f"_{number}" for number in range(len(shape.planes))] or [""]
        return tuple(
            Coefficient(f"{quantity}{suffix}", unit, sd)
            for suffix in suffixes
            for quantity, unit, sd in (
                ("offset_m", "m", 0.01),
                ("lean_x", "rad", 0.01),
                ("lean_y", "rad", 0.01),
            )
        )

    def shift(self, inputs: EffectInputs, coefficients: Tensor) -> Tensor:
        """Return how much farther the rays meet the true plane, shape (M,), metres."""
        facts = inputs.facts
        pose = facts.world_from_tool @ inputs.tool_from_camera
        normal, offset = self._moved(facts.normal_world, facts.offset, coefficients)
        recorded = (facts.normal_world, facts.offset)
        return distance_along_rays(
            inputs.rays, inputs.frame, pose, normal, offset
        ) - distance_along_rays(inputs.rays, inputs.frame, pose, *recorded)

    def on_pose(self, state: FrameState) -> None:
        """Move the plane."""
        normal, offset = self._moved(
            state.normal_world[None], state.offset.reshape(1), self.coefficients
        )
        state.normal_world, state.offset = normal[0], offset[0]

    def _moved(self, normal: Tensor, offset: Tensor, coefficients: Tensor) -> tuple[Tensor, Tensor]:
        shape = self.shape
        error = coefficients.reshape(-1, 3)[self._numbers(normal, offset)]
        u, v = (-tangents(normal)).unbind(-2)
        leaning = normal + error[:, 1:2] * u + error[:, 2:3] * v
        leaning = leaning / leaning.norm(dim=1, keepdim=True)
        pivot = normal.new_tensor(shape.pivot_m)
        return leaning, offset + error[:, 0] - ((leaning - normal) * pivot).sum(1)

    def _numbers(self, normal: Tensor, offset: Tensor) -> Tensor:
        """Return the index of each frame's plane in the shape, shape (F,)."""
        shape = self.shape
        if not shape.planes:
            return torch.zeros(len(offset), dtype=torch.int64)
        planes = torch.cat([normal, offset[:, None]], dim=1)
        return torch.cdist(planes, planes.new_tensor(shape.planes)).argmin(dim=1)
