"""Viewing rays that differ from those of the intrinsics."""

import torch
from torch import Tensor

from tofcorr.geometry.planes import distance_along_rays
from tofcorr.options import Options
from tofcorr.simulation.effects.base import CatalogueEffect, Coefficient
from tofcorr.simulation.effects.inputs import EffectInputs
from tofcorr.simulation.hooks import FrameState

_TERMS = (
    Coefficient("focal_x", "1", 0.02),
    Coefficient("focal_y", "1", 0.02),
    Coefficient("centre_x_px", "px", 3.0),
    Coefficient("centre_y_px", "px", 3.0),
    Coefficient("radial_2", "1", 0.05),
    Coefficient("radial_4", "1", 0.1),
    Coefficient("tangential_x", "1", 0.01),
    Coefficient("tangential_y", "1", 0.01),
    Coefficient("skew", "1", 0.01),
    Coefficient("prism_x", "1", 0.01),
    Coefficient("prism_y", "1", 0.01),
)


class LensEffect(CatalogueEffect):
    r"""Error of focal length, principal point and distortion.

    .. math:: x' = x (1 + f_x + k_2 \rho^2 + k_4 \rho^4) + c_x / f + 2 t_y x y
              + t_x (\rho^2 + 2 x^2) + s y + p_x \rho^2

    and similarly y' (without skew s), for the ray (x, y, 1) of the intrinsics and the true ray
    (x', y', 1). This is Brown's model (1971) with a thin prism, applied to rays instead of pixels.
    The true ray meets the target at another point, so the measured distance differs.
    """

    name = "lens"
    summary = "focal length, principal point, skew or distortion other than recorded"
    source = "Brown 1971, close-range camera calibration"
    remedy = "strong tilts in four directions at several distances; calibrate the lens again"

    @classmethod
    def terms(cls, shape: Options) -> tuple[Coefficient, ...]:
        """Return the errors of the intrinsics."""
        del shape
        return _TERMS

    def shift(self, inputs: EffectInputs, coefficients: Tensor) -> Tensor:
        """Return how much farther the true ray meets the target, shape (M,), metres."""
        true_rays = _bent(inputs.rays, coefficients, _focal_length(inputs.camera.matrix))
        normals = inputs.normals_camera
        if normals is not None:
            # n . (d v) = n . (d' v') on the tangent plane of the surface in this pixel.
            ratio = (normals * inputs.rays).sum(-1) / (normals * true_rays).sum(-1)
            return inputs.radial_distance * (ratio - 1)
        facts = inputs.facts
        world_from_camera = facts.world_from_tool @ inputs.tool_from_camera
        plane = (inputs.frame, world_from_camera, facts.normal_world, facts.offset)
        return distance_along_rays(true_rays, *plane) - distance_along_rays(inputs.rays, *plane)

    def on_pose(self, state: FrameState) -> None:
        """Bend the rays."""
        focal = _focal_length(state.camera.matrix)
        rays = _bent(state.ray_directions.reshape(-1, 3), self.coefficients, focal)
        state.ray_directions = rays.reshape(state.ray_directions.shape)


def _focal_length(matrix: tuple[tuple[float, ...], ...]) -> float:
    return (matrix[0][0] + matrix[1][1]) / 2


def _bent(rays: Tensor, c: Tensor, focal: float) -> Tensor:
    x, y = rays[:, 0] / rays[:, 2], rays[:, 1] / rays[:, 2]
    square = x**2 + y**2
    radial = c[4] * square + c[5] * square**2
    bent_x = x * (1 + c[0] + radial) + c[2] / focal + 2 * c[7] * x * y + c[6] * (square + 2 * x**2)
    bent_y = y * (1 + c[1] + radial) + c[3] / focal + 2 * c[6] * x * y + c[7] * (square + 2 * y**2)
    bent_x = bent_x + c[8] * y + c[9] * square
    bent_y = bent_y + c[10] * square
    bent = torch.stack([bent_x, bent_y, torch.ones_like(x)], dim=-1)
    return bent / bent.norm(dim=-1, keepdim=True)
