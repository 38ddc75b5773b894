"""Planes n . x + d = 0 with a unit normal."""

import torch
from torch import Tensor

# A ray closer to the plane than this (cosine of the incidence angle) meets it nowhere useful.
_GRAZING_COSINE = 1e-6


def plane_in_frame(
    normal_world: Tensor, offset: Tensor, world_from_frame: Tensor
) -> tuple[Tensor, Tensor]:
    """Express planes in another frame: x_world = world_from_frame x_frame.

    Args:
        normal_world: Unit normals, shape (..., 3).
        offset: Offsets d of n . x + d = 0, shape (...), metres.
        world_from_frame: Rigid transforms, shape (..., 4, 4).

    Returns:
        Normals (..., 3) and offsets (...) of the same planes in the frame.
    """
    rotation, translation = world_from_frame[..., :3, :3], world_from_frame[..., :3, 3]
    normal = (normal_world[..., None, :] @ rotation)[..., 0, :]
    return normal, offset + (normal_world * translation).sum(-1)


def signed_distance(points: Tensor, normal: Tensor, offset: Tensor) -> Tensor:
    """Return n . x + d of points (..., P, 3) for planes (..., 3) and (...): shape (..., P)."""
    return (points @ normal[..., :, None])[..., 0] + offset[..., None]


def ray_plane_distance(ray_directions: Tensor, normal: Tensor, offset: Tensor) -> Tensor:
    """Return how far along each ray from the origin its plane lies.

    Args:
        ray_directions: Unit rays, shape (H, W, 3).
        normal: Unit normals in the frame of the rays, shape (..., 3).
        offset: Offsets, shape (...), metres.

    Returns:
        Distances, shape (..., H, W), metres; NaN where the ray is parallel to the plane or the
        plane lies behind the origin.
    """
    cosine = torch.einsum("hwk,...k->...hw", ray_directions, normal)
    distance = -offset[..., None, None] / cosine
    meets = (cosine.abs() > _GRAZING_COSINE) & (distance > 0)
    return torch.where(meets, distance, torch.nan)
