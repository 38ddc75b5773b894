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
        focal = _focal_length(inputs.camera.matrix)
        if inputs.normals_camera is not None:
            return _on_surfaces(inputs, inputs.normals_camera, coefficients, focal)
        true_rays = _bent(inputs.rays, coefficients, focal)
        plane = _planes(inputs)
        return distance_along_rays(true_rays, *plane) - distance_along_rays(inputs.rays, *plane)

    def slope(self, inputs: EffectInputs, coefficients: Tensor) -> Tensor:
        """Return the derivative of `shift`, shape (M, K), metres.

        With h = n . (d v), the ray b of any length meets the plane at d' = h |b| / (n . b). The
        derivative of d' by b is d' (b / |b|^2 - n / (n . b)).
        """
        by_x, by_y = _ray_columns(inputs.rays, _focal_length(inputs.camera.matrix))
        x, y = (inputs.rays[:, axis] / inputs.rays[:, 2] for axis in (0, 1))
        x, y = x + by_x @ coefficients, y + by_y @ coefficients
        normals, before = inputs.normals_camera, inputs.radial_distance
        if normals is None:
            frame, world_from_camera, normal_world, _ = plane = _planes(inputs)
            normals = (normal_world[:, None, :] @ world_from_camera[:, :3, :3])[frame, 0]
            before = distance_along_rays(inputs.rays, *plane)
        true = before + self.shift(inputs, coefficients)
        along = normals[:, 0] * x + normals[:, 1] * y + normals[:, 2]
        square = 1 + x**2 + y**2
        own_x = true * (x / square - normals[:, 0] / along)
        own_y = true * (y / square - normals[:, 1] / along)
        return own_x[:, None] * by_x + own_y[:, None] * by_y

    def on_pose(self, state: FrameState) -> None:
        """Bend the rays."""
        focal = _focal_length(state.camera.matrix)
        rays = _bent(state.ray_directions.reshape(-1, 3), self.coefficients, focal)
        state.ray_directions = rays.reshape(state.ray_directions.shape)


def _focal_length(matrix: tuple[tuple[float, ...], ...]) -> float:
    return (matrix[0][0] + matrix[1][1]) / 2


def _planes(inputs: EffectInputs) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Return what `distance_along_rays` takes after the rays."""
    facts = inputs.facts
    world_from_camera = facts.world_from_tool @ inputs.tool_from_camera
    return inputs.frame, world_from_camera, facts.normal_world, facts.offset


def _on_surfaces(inputs: EffectInputs, normals: Tensor, c: Tensor, focal: float) -> Tensor:
    """Return how much farther the true ray meets the tangent plane in each pixel, (M,), metres.

    n . (d v) = n . (d' v') for the rays v and v' of unit length along (x, y, 1) and (x', y', 1).
    """
    along_x, along_y, along_z = inputs.rays.unbind(-1)
    x, y = along_x / along_z, along_y / along_z
    bent_x, bent_y = _bent_places(x, y, c, focal)
    n_x, n_y, n_z = normals.unbind(-1)
    facing = (n_x * x + n_y * y + n_z) / (n_x * bent_x + n_y * bent_y + n_z)
    longer = (bent_x.square() + bent_y.square() + 1).sqrt() * along_z
    return inputs.radial_distance * (facing * longer - 1)


def _bent_places(x: Tensor, y: Tensor, c: Tensor, focal: float) -> tuple[Tensor, Tensor]:
    """Return x' and y' of rays (x, y, 1), each of shape (M,)."""
    # Coefficients in the order of `_TERMS`; the sum of `_ray_changes`, with its factors taken out.
    focal_x, focal_y, centre_x, centre_y, r_2, r_4, t_x, t_y, skew, prism_x, prism_y = c.to(
        x.dtype
    ).unbind(0)
    square = x.square() + y.square()
    radial = square * (r_2 + r_4 * square) + 2 * (t_x * x + t_y * y)
    bent_x = x * (1 + focal_x + radial) + (t_x + prism_x) * square + skew * y + centre_x / focal
    bent_y = y * (1 + focal_y + radial) + (t_y + prism_y) * square + centre_y / focal
    return bent_x, bent_y


def _bent(rays: Tensor, c: Tensor, focal: float) -> Tensor:
    """Return the true rays, of unit length."""
    x, y = _bent_places(rays[:, 0] / rays[:, 2], rays[:, 1] / rays[:, 2], c, focal)
    bent = torch.stack([x, y, torch.ones_like(x)], dim=-1)
    return bent / bent.norm(dim=-1, keepdim=True)


def _ray_columns(rays: Tensor, focal: float) -> tuple[Tensor, Tensor]:
    """Return by how much each coefficient moves x and y of the ray (x, y, 1), (M, K) each."""
    by_x, by_y = _ray_changes(rays[:, 0] / rays[:, 2], rays[:, 1] / rays[:, 2], focal)
    return torch.stack(by_x, dim=-1), torch.stack(by_y, dim=-1)


def _ray_changes(x: Tensor, y: Tensor, focal: float) -> tuple[list[Tensor], list[Tensor]]:
    """Return the same for each coefficient by itself, (M,) each."""
    square, product = x**2 + y**2, 2 * x * y
    none, pixel = torch.zeros_like(x), torch.full_like(x, 1 / focal)
    far, wide, high = square**2, square + 2 * x**2, square + 2 * y**2
    # In the order of `_TERMS`: focal length, centre, radial, tangential, skew, prism.
    by_x = [x, none, pixel, none, x * square, x * far, wide, product, y, square, none]
    by_y = [none, y, none, pixel, y * square, y * far, product, high, none, none, square]
    return by_x, by_y
