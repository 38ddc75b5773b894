"""Surfaces in a depth image: the plane through each pixel, and the angle at which rays meet it."""

from typing import NamedTuple

import torch
from torch import Tensor, nn

# Least cosine between ray and normal (89.4 degrees; no unit). Chosen: keeps light and slant finite
# at the outlines of objects.
_LEAST_COSINE = 0.01
_AXES = (-2, -1)  # Down and to the right.


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
        return -(torch.stack([self.a, self.b, self.c]) / self.length).movedim(0, -1)


class SurfaceFinder(nn.Module):
    """Finds the plane through each pixel and its neighbours.

    On a plane 1/Z is linear in x = X/Z and y = Y/Z. Its slope is taken to the neighbour, on each
    axis, towards which 1/Z changes less: never across the outline of an object. On a plane the
    result is exact; without a neighbour the surface is taken as parallel to the image.

    Args:
        ray_directions: Unit rays, shape (H, W, 3), both sides at least 2 pixels.
    """

    slant: Tensor
    place: Tensor
    steps: Tensor

    def __init__(self, ray_directions: Tensor) -> None:
        super().__init__()
        self.register_buffer("slant", ray_directions[..., 2].clone())
        place = (ray_directions[..., :2] / ray_directions[..., 2:]).movedim(-1, 0).contiguous()
        self.register_buffer("place", place)
        ends = [_both_ways(place.diff(dim=axis), axis) for axis in _AXES]
        self.register_buffer("steps", torch.stack([torch.stack(pair) for pair in ends]))

    def forward(self, radial_distance: Tensor, seen: Tensor) -> Surface:
        """Return the planes.

        Args:
            radial_distance: Shape (..., H, W), metres, finite.
            seen: Where there is a surface, shape (..., H, W), bool.
        """
        x, y = self.place
        inverse = 1 / (radial_distance * self.slant)
        down, right = (self._step(number, inverse, seen) for number in range(len(_AXES)))
        known = (down.known & right.known).to(inverse.dtype)
        scale = known / _determinant(right.x, right.y, down.x, down.y)
        a = scale * _determinant(right.inverse, right.y, down.inverse, down.y)
        b = scale * _determinant(right.x, right.inverse, down.x, down.inverse)
        c = torch.addcmul(torch.addcmul(inverse, a, x, value=-1), b, y, value=-1)
        length = torch.addcmul(torch.addcmul(a.square(), b, b), c, c).sqrt()
        cosine = (1 / (radial_distance * length)).clamp(_LEAST_COSINE, 1.0)
        return Surface(a, b, c, length, cosine)

    def _step(self, number: int, inverse: Tensor, seen: Tensor) -> "_Step":
        axis = _AXES[number]
        count = inverse.shape[axis]
        nothing = torch.zeros_like(seen.narrow(axis, 0, 1))
        both = seen.narrow(axis, 0, count - 1) & seen.narrow(axis, 1, count - 1)
        both = torch.cat([nothing, both, nothing], axis)
        change = _with_ends(inverse.diff(dim=axis), axis)
        size = torch.where(both, change.detach().abs(), torch.inf)
        backward = size.narrow(axis, 0, count) <= size.narrow(axis, 1, count)
        (x_before, y_before), (x_after, y_after) = self.steps[number]
        # With weights 0 and 1 `lerp` chooses exactly, and faster than `where` in a noisy mask.
        chosen = backward.to(change.dtype)
        return _Step(
            torch.lerp(change.narrow(axis, 1, count), change.narrow(axis, 0, count), chosen),
            torch.lerp(x_after, x_before, chosen),
            torch.lerp(y_after, y_before, chosen),
            both.narrow(axis, 0, count) | both.narrow(axis, 1, count),
        )


class _Step(NamedTuple):
    """From a pixel to its neighbour along one axis: changes, and whether there is a neighbour."""

    inverse: Tensor
    x: Tensor
    y: Tensor
    known: Tensor


def _determinant(a: Tensor, b: Tensor, c: Tensor, d: Tensor) -> Tensor:
    return torch.addcmul(a * d, b, c, value=-1)


def _with_ends(change: Tensor, axis: int) -> Tensor:
    """Repeat the first and the last change between neighbours: one before and after each pixel."""
    first, last = change.narrow(axis, 0, 1), change.narrow(axis, change.shape[axis] - 1, 1)
    return torch.cat([first, change, last], axis)


def _both_ways(change: Tensor, axis: int) -> tuple[Tensor, Tensor]:
    """Return the change to each pixel from the one before, and from it to the one after."""
    change = _with_ends(change, axis)
    count = change.shape[axis] - 1
    return change.narrow(axis, 0, count), change.narrow(axis, 1, count)
