"""Viewing rays that differ from those of the intrinsics."""

import torch
from torch import Tensor

from tofcorr.geometry.camera import CameraIntrinsics
from tofcorr.simulation.effects.base import (
    CatalogueEffect,
    Coefficient,
    EffectInputs,
)
from tofcorr.simulation.hooks import FrameState


class LensEffect(CatalogueEffect):
    r"""Error of focal length, principal point and distortion.

    .. math:: x' = x (1 + f_x + k_2 \rho^2 + k_4 \rho^4) + c_x / f + 2 t_y x y
              + t_x (\rho^2 + 2 x^2) + s y + p_x \rho^2

    and similarly y' (without skew s), for the ray (x, y, 1) of the intrinsics and the true ray
    (x', y', 1). This is Brown's model (1971) with a thin prism, applied to rays instead of pixels.
    The true ray meets the target at another point, so the measured distance differs.

    Source: Brown 1971, close-range camera calibration.
    """

    name = "lens"
    summary = "focal length, principal point, skew or distortion other than recorded"
    remedy = "strong tilts in four directions at several distances; calibrate the lens again"
    fixed_terms = (
        *(Coefficient(f"focal_{axis}", "1", 0.02) for axis in "xy"),
        *(Coefficient(f"centre_{axis}_px", "px", 3.0) for axis in "xy"),
        Coefficient("radial_2", "1", 0.05),
        Coefficient("radial_4", "1", 0.1),
        *(Coefficient(f"tangential_{axis}", "1", 0.01) for axis in "xy"),
        Coefficient("skew", "1", 0.01),
        *(Coefficient(f"prism_{axis}", "1", 0.01) for axis in "xy"),
    )

    def shift(self, inputs: EffectInputs, coefficients: Tensor) -> Tensor:
        """Return how much farther the true ray meets the target, shape (M,), metres.

        n . (d v) = n . (d' v') for the unit rays v and v' and the normal n.
        """
        normal = inputs.normals_camera
        if normal is None:
            normal = inputs.facts.planes_seen(inputs.tool_from_camera)[0][inputs.frame]
        rays = true_rays(inputs.rays, coefficients, _focal(inputs.camera))
        facing = (inputs.rays * normal).sum(-1) / (rays * normal).sum(-1)
        return inputs.radial_distance * (facing - 1)

    def on_pose(self, state: FrameState) -> None:
        """Bend the rays."""
        focal = _focal(state.camera)
        state.ray_directions = true_rays(state.ray_directions, self.coefficients, focal)


def true_rays(rays: Tensor, coefficients: Tensor, focal: float) -> Tensor:
    """Return the true unit rays, of the shape of those of the intrinsics, (..., 3).

    Args:
        rays: Of the intrinsics.
        coefficients: In the order of `fixed_terms`, shape (11,).
        focal: Focal length, pixels.
    """
    x, y = rays[..., 0] / rays[..., 2], rays[..., 1] / rays[..., 2]
    for coefficient, by_x, by_y in zip(coefficients.to(x), *_changes(x, y, focal), strict=True):
        x, y = x + coefficient * by_x, y + coefficient * by_y
    bent = torch.stack([x, y, torch.ones_like(x)], dim=-1)
    return bent / bent.norm(dim=-1, keepdim=True)


def _focal(camera: CameraIntrinsics) -> float:
    return (camera.matrix[0][0] + camera.matrix[1][1]) / 2


def _changes(x: Tensor, y: Tensor, focal: float) -> tuple[list[Tensor], list[Tensor]]:
    """Return by how much each coefficient moves x and y of the ray (x, y, 1), of their shape."""
    square, product = x**2 + y**2, 2 * x * y
    none, pixel = torch.zeros_like(x), torch.full_like(x, 1 / focal)
    far, wide, high = square**2, square + 2 * x**2, square + 2 * y**2
    # In the order of the coefficients: focal length, centre, radial, tangential, skew, prism.
    by_x = [x, none, pixel, none, x * square, x * far, wide, product, y, square, none]
    by_y = [none, y, none, pixel, y * square, y * far, product, high, none, none, square]
    return by_x, by_y
