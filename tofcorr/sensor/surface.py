"""Surfaces in a depth image: the plane through each pixel, and the angle at which rays meet it."""

from typing import NamedTuple

import torch
from torch import Tensor

# Least cosine between ray and normal (89.4 degrees; no unit). Chosen: keeps light and slant finite
# at the outlines of objects.
_LEAST_COSINE = 0.01


class Surface(NamedTuple):
    """The plane a X + b Y + c Z = 1 through each pixel, in the camera frame.

    Attributes:
        a, b, c: Shape (..., H, W), 1 / metres.
        length: Of (a, b, c): 1 over the distance of the plane from the camera.
        incidence_cosine: Between the way back along the ray and the normal, shape (..., H, W).
    """

    a: Tensor
    b: Tensor
    c: Tensor
    length: Tensor
    incidence_cosine: Tensor

    def normals(self) -> Tensor:
        """Return unit normals on the camera's side, shape (..., H, W, 3)."""
        return -torch.stack([self.a, self.b, self.c], dim=-1) / self.length[..., None]


def surface_of(radial_distance: Tensor, seen: Tensor, ray_directions: Tensor) -> Surface:
    """Return the plane through each pixel and its neighbours.

    On a plane 1/Z is linear in x = X/Z and y = Y/Z. Its slope is taken to the neighbour, on each
    axis, towards which 1/Z changes less: never across the outline of an object. On a plane the
    result is exact; without a neighbour the surface is taken as parallel to the image.

    Args:
        radial_distance: Shape (..., H, W), metres, finite; both sides at least 2 pixels.
        seen: Where there is a surface, shape (..., H, W), bool.
        ray_directions: Unit rays, shape (H, W, 3).
    """
    x = ray_directions[..., 0] / ray_directions[..., 2]
    y = ray_directions[..., 1] / ray_directions[..., 2]
    inverse = 1 / (radial_distance * ray_directions[..., 2])
    down = _step(inverse, seen, x, y, -2)
    right = _step(inverse, seen, x, y, -1)
    determinant = right.x * down.y - right.y * down.x
    known = down.known & right.known
    a = torch.where(known, (right.inverse * down.y - down.inverse * right.y) / determinant, 0.0)
    b = torch.where(known, (down.inverse * right.x - right.inverse * down.x) / determinant, 0.0)
    c = inverse - a * x - b * y
    length = (a.square() + b.square() + c.square()).sqrt()
    cosine = (1 / (radial_distance * length)).clamp(_LEAST_COSINE, 1.0)
    return Surface(a, b, c, length, cosine)


class _Step(NamedTuple):
    """From a pixel to its neighbour along one axis: changes, and whether there is a neighbour."""

    inverse: Tensor
    x: Tensor
    y: Tensor
    known: Tensor


def _step(inverse: Tensor, seen: Tensor, x: Tensor, y: Tensor, axis: int) -> _Step:
    change = inverse.diff(dim=axis)
    count = inverse.shape[axis]
    both = seen.narrow(axis, 0, count - 1) & seen.narrow(axis, 1, count - 1)
    size = torch.where(both, change.detach().abs(), torch.inf)
    none = torch.full_like(size.narrow(axis, 0, 1), torch.inf)
    before, after = torch.cat([none, size], axis), torch.cat([size, none], axis)
    backward = before <= after

    def chosen(step: Tensor) -> Tensor:
        ends = [step.narrow(axis, 0, 1), step, step.narrow(axis, count - 2, 1)]
        return torch.where(backward, torch.cat(ends[:2], axis), torch.cat(ends[1:], axis))

    known = torch.minimum(before, after) < torch.inf
    return _Step(chosen(change), chosen(x.diff(dim=axis)), chosen(y.diff(dim=axis)), known)
