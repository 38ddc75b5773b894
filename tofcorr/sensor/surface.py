"""Surfaces in a depth image: normals, and the angle at which rays meet them."""

import torch
from torch import Tensor

# Least cosine between ray and normal (89.4 degrees; no unit). Chosen: keeps light and slant finite
# at the outlines of objects.
_LEAST_COSINE = 0.01


def normals_of(radial_distance: Tensor, seen: Tensor, ray_directions: Tensor) -> Tensor:
    """Return the unit normal of the surface in each pixel, on the camera's side.

    The tangents are steps to neighbours, on the side where the distance changes less, so that no
    normal is taken across the outline of an object. On a plane the result is exact.

    Args:
        radial_distance: Shape (..., H, W), metres, finite; both sides at least 2 pixels.
        seen: Where there is a surface, shape (..., H, W), bool.
        ray_directions: Unit rays, shape (H, W, 3).

    Returns:
        In the camera frame, shape (..., H, W, 3); towards the camera where no neighbour has a
        surface.
    """
    points = radial_distance[..., None] * ray_directions
    down, down_known = _tangent(points, seen, -2)
    right, right_known = _tangent(points, seen, -1)
    normal = torch.linalg.cross(down, right)
    known = down_known & right_known & (normal.detach().square().sum(-1) > 0)
    normal = torch.where(known[..., None], normal, -ray_directions)
    normal = normal / torch.linalg.vector_norm(normal, dim=-1, keepdim=True)
    away = (normal * ray_directions).sum(-1, keepdim=True) > 0
    return torch.where(away, -normal, normal)


def incidence_cosine_of(normals: Tensor, ray_directions: Tensor) -> Tensor:
    """Return the cosine between the way back along each ray and the normal, shape (..., H, W)."""
    cosine = -(normals * ray_directions).sum(-1)
    return cosine.clamp(_LEAST_COSINE, 1.0)


def _tangent(points: Tensor, seen: Tensor, axis: int) -> tuple[Tensor, Tensor]:
    """Return the smaller of the steps to the neighbours along an image axis, and where it is known.

    Args:
        points: Shape (..., H, W, 3).
        seen: Shape (..., H, W).
        axis: Of the image: -2 down, -1 to the right.
    """
    count = points.shape[axis - 1]
    step = points.diff(dim=axis - 1)
    length = step.detach().square().sum(-1)
    both = seen.narrow(axis, 0, count - 1) & seen.narrow(axis, 1, count - 1)
    length = torch.where(both, length, torch.inf)
    nothing = torch.full_like(length.narrow(axis, 0, 1), torch.inf)
    before, after = torch.cat([nothing, length], axis), torch.cat([length, nothing], axis)
    first, last = step.narrow(axis - 1, 0, 1), step.narrow(axis - 1, count - 2, 1)
    earlier, later = torch.cat([first, step], axis - 1), torch.cat([step, last], axis - 1)
    shorter = torch.where((before <= after)[..., None], earlier, later)
    return shorter, torch.minimum(before, after).isfinite()
