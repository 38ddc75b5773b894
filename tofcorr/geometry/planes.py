"""Planes n . x + d = 0 with a unit normal, and the rays that meet them."""

import torch
from jaxtyping import Float, Int
from torch import Tensor

# Smallest |cosine| of the incidence angle (no unit) at which a ray counts as meeting the plane.
# Chosen by hand: at 1e-6 a plane 1 m away is met at 1000 km, far beyond any camera's range.
_GRAZING_COSINE = 1e-6


def plane_in_frame(
    normal_world: Float[Tensor, "*batch 3"],
    offset: Float[Tensor, "*batch"],
    world_from_frame: Float[Tensor, "*batch 4 4"],
) -> tuple[Float[Tensor, "*batch 3"], Float[Tensor, "*batch"]]:
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


def signed_distance(
    points: Float[Tensor, "*batch P 3"],
    normal: Float[Tensor, "*batch 3"],
    offset: Float[Tensor, "*batch"],
) -> Float[Tensor, "*batch P"]:
    """Return n . x + d of points (..., P, 3) for planes (..., 3) and (...): shape (..., P)."""
    return (points @ normal[..., :, None])[..., 0] + offset[..., None]


def ray_plane_distance(
    ray_directions: Float[Tensor, "H W 3"],
    normal: Float[Tensor, "*batch 3"],
    offset: Float[Tensor, "*batch"],
) -> Float[Tensor, "*batch H W"]:
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


def distance_along_rays(
    rays: Float[Tensor, "M 3"],
    frame: Int[Tensor, "M"],
    world_from_camera: Float[Tensor, "F 4 4"],
    normal_world: Float[Tensor, "F 3"],
    offset: Float[Tensor, "F"],
) -> Float[Tensor, "M"]:
    """Return how far along each ray the plane of its frame lies, for rays of many frames.

    Args:
        rays: Viewing rays in the camera frame, shape (M, 3). They need not have unit length; the
            result is in multiples of their lengths.
        frame: Index of the frame of each ray, shape (M,).
        world_from_camera: Shape (F, 4, 4).
        normal_world: Unit normals, shape (F, 3).
        offset: d of n . x + d = 0, shape (F,), metres.

    Returns:
        Shape (M,). Nothing is masked: a ray that points away from the plane gives a negative value.
    """
    normal_camera = (normal_world[:, None, :] @ world_from_camera[:, :3, :3])[:, 0]
    height = (normal_world * world_from_camera[:, :3, 3]).sum(-1) + offset
    return -height[frame] / (rays * normal_camera[frame]).sum(-1)


def tangents(normal: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 2 3"]:
    """Return two unit vectors that span the plane of each normal.

    The first is n x e, normalised, with e the coordinate axis that is farthest from n; the second
    is n x first. They are orthogonal to each other and to n.

    Args:
        normal: Unit normals, shape (..., 3).

    Returns:
        Shape (..., 2, 3).
    """
    axis = torch.eye(3, dtype=normal.dtype, device=normal.device)[normal.detach().abs().argmin(-1)]
    first = torch.nn.functional.normalize(torch.linalg.cross(normal, axis), dim=-1)
    return torch.stack([first, torch.linalg.cross(normal, first)], dim=-2)
