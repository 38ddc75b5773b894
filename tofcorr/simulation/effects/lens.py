"""Viewing rays that differ from those of the intrinsics."""

import torch
from torch import Tensor

from tofcorr.geometry.camera import CameraIntrinsics
from tofcorr.simulation.effects.base import CatalogueEffect, Coefficient, plane_in_camera
from tofcorr.simulation.effects.inputs import EffectInputs
from tofcorr.simulation.hooks import FrameState


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
    fixed_terms = (
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

    def shift(self, inputs: EffectInputs, coefficients: Tensor) -> Tensor:
        """Return how much farther the true ray meets the target, shape (M,), metres.

        n . (d v) = n . (d' v') for the rays v and v' of unit length along (x, y, 1), (x', y', 1).
        """
        normals, distance = _surfaces(inputs)
        x, y = _places(inputs.rays)
        true_x, true_y = _true_places(x, y, coefficients, _focal(inputs.camera))
        facing = _facing(normals, x, y) / _facing(normals, true_x, true_y)
        longer = (true_x.square() + true_y.square() + 1).sqrt() * inputs.rays[:, 2]
        return distance * (facing * longer - 1)

    def slope(self, inputs: EffectInputs, coefficients: Tensor) -> Tensor:
        """Return the derivative of `shift`, shape (M, K), metres.

        With h = n . (d v), the ray b of any length meets the plane at d' = h |b| / (n . b). The
        derivative of d' by b is d' (b / |b|^2 - n / (n . b)).
        """
        normals, distance = _surfaces(inputs)
        x, y = _places(inputs.rays)
        by_x, by_y = (torch.stack(part, dim=-1) for part in _changes(x, y, _focal(inputs.camera)))
        x, y = _true_places(x, y, coefficients, _focal(inputs.camera))
        true = distance + self.shift(inputs, coefficients)
        along, square = _facing(normals, x, y), 1 + x**2 + y**2
        own_x = true * (x / square - normals[:, 0] / along)
        own_y = true * (y / square - normals[:, 1] / along)
        return own_x[:, None] * by_x + own_y[:, None] * by_y

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
    x, y = _true_places(*_places(rays), coefficients, focal)
    bent = torch.stack([x, y, torch.ones_like(x)], dim=-1)
    return bent / bent.norm(dim=-1, keepdim=True)


def _focal(camera: CameraIntrinsics) -> float:
    return (camera.matrix[0][0] + camera.matrix[1][1]) / 2


def _surfaces(inputs: EffectInputs) -> tuple[Tensor, Tensor]:
    """Return the normals (M, 3) that the rays meet, in the camera frame, and distances (M,)."""
    if inputs.normals_camera is not None:
        return inputs.normals_camera, inputs.radial_distance
    facts, frame = inputs.facts, inputs.frame
    recorded = facts.world_from_tool, facts.normal_world, facts.offset
    normal, height = plane_in_camera(inputs, *recorded)
    return normal[frame], -height[frame, 0] / (inputs.rays * normal[frame]).sum(-1)


def _places(rays: Tensor) -> tuple[Tensor, Tensor]:
    """Return x and y of rays (..., 3) along (x, y, 1)."""
    return rays[..., 0] / rays[..., 2], rays[..., 1] / rays[..., 2]


def _facing(normals: Tensor, x: Tensor, y: Tensor) -> Tensor:
    return normals[:, 0] * x + normals[:, 1] * y + normals[:, 2]


def _true_places(x: Tensor, y: Tensor, coefficients: Tensor, focal: float) -> tuple[Tensor, Tensor]:
    """Return x' and y' of the true rays, of the shape of x."""
    for coefficient, by_x, by_y in zip(coefficients, *_changes(x, y, focal), strict=True):
        x, y = x + coefficient.to(x) * by_x, y + coefficient.to(y) * by_y
    return x, y


def _changes(x: Tensor, y: Tensor, focal: float) -> tuple[list[Tensor], list[Tensor]]:
    """Return by how much each coefficient moves x and y of the ray (x, y, 1), of their shape."""
    square, product = x**2 + y**2, 2 * x * y
    none = torch.zeros_like(x)
    pixel = torch.full_like(x, 1 / focal)
    far, wide, high = square**2, square + 2 * x**2, square + 2 * y**2
    # In the order of the coefficients: focal length, centre, radial, tangential, skew, prism.
    by_x = [x, none, pixel, none, x * square, x * far, wide, product, y, square, none]
    by_y = [none, y, none, pixel, y * square, y * far, product, high, none, none, square]
    return by_x, by_y
