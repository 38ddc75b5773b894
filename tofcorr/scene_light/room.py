"""A room that is known: flat faces of what stands around, seen or not."""

from typing import Annotated, Self

import torch
from pydantic import Field, model_validator
from torch import Tensor, nn

from tofcorr.options import Number, Options


class Face(Options):
    """A flat part of a room.

    Attributes:
        corners: Of a convex polygon, in order, metres.
        reflectivity: Share of the light that it sends back, while no frame shows it.
    """

    corners: Annotated[tuple[tuple[Number, Number, Number], ...], Field(min_length=3)]
    reflectivity: Annotated[Number, Field(gt=0, le=1)] = 0.5

    @model_validator(mode="after")
    def _flat_and_convex(self) -> Self:
        """Refuse corners that are not in one plane, or not of a convex polygon."""
        corners = torch.tensor(self.corners, dtype=torch.float64)
        sides = corners.roll(-1, 0) - corners
        normal = torch.linalg.cross(corners, corners.roll(-1, 0)).sum(0)
        size = normal.norm()
        turns = torch.linalg.cross(sides, sides.roll(-1, 0)) @ normal
        off = (corners - corners.mean(0)) @ normal / size
        if not size > 0 or not off.abs().max() < size.sqrt() / 100 or not (turns >= 0).all():
            raise ValueError("'corners': expected a flat and convex polygon, its corners in order")
        return self


class Room(nn.Module):
    """What rays from the camera meet of a room.

    Args:
        faces: In the axes of a world, or of the camera.
        in_world: Which of the two.

    Attributes:
        frame: Of a batch: the one that is looked at.
    """

    corners: Tensor
    reflectivity: Tensor
    poses: Tensor

    def __init__(self, faces: tuple[Face, ...], *, in_world: bool) -> None:
        super().__init__()
        self.in_world: bool = in_world
        self.frame: int = 0
        pose = torch.eye(4, dtype=torch.float64) * (torch.nan if in_world else 1.0)
        self.register_buffer("poses", pose[None], persistent=False)
        most = max((len(face.corners) for face in faces), default=3)
        # A corner that is there twice changes no polygon.
        rows = [[*face.corners, *face.corners[-1:] * (most - len(face.corners))] for face in faces]
        corners = torch.tensor(rows, dtype=torch.float64).reshape(-1, most, 3)
        self.register_buffer("corners", corners)
        reflectivity = torch.tensor([face.reflectivity for face in faces], dtype=torch.float64)
        self.register_buffer("reflectivity", reflectivity)

    def set_pose(self, world_from_camera: Tensor) -> None:
        """Say where the camera is in the next frames: poses (4, 4), or (B, 4, 4) of a batch.

        It changes nothing where the room is in the camera's axes.
        """
        if self.in_world:
            self.poses = world_from_camera.detach().to(self.poses).reshape(-1, 4, 4)

    def met(self, rays: Tensor) -> tuple[Tensor, Tensor]:
        """Return g of 1 / r = g . ray (3, N) and the reflectivity (N,) of the first face met.

        NaN where a ray meets none, and while the pose is not known.

        Args:
            rays: Unit directions in the camera's axes (3, N).
        """
        pose = self.poses[min(self.frame, self.poses.shape[0] - 1)].double()
        nothing = torch.full_like(rays[:1], torch.nan)
        if self.corners.shape[0] == 0:
            return nothing.expand(3, -1), nothing[0]
        corners = (self.corners.double() - pose[:3, 3]) @ pose[:3, :3]
        edges = torch.linalg.cross(corners, corners.roll(-1, 1), dim=2)
        normal = edges.sum(1)
        planes = normal / (normal * corners[:, 0]).sum(1, keepdim=True)
        sides, near = edges @ rays, planes @ rays
        inside = (sides >= 0).all(1) | (sides <= 0).all(1)
        inside = inside & near.isfinite() & (near > 0)
        first, face = torch.where(inside, near, 0.0).max(0)
        planes = torch.where(first > 0, planes.T[:, face], torch.nan)
        return planes, torch.where(first > 0, self.reflectivity.double()[face], torch.nan)
