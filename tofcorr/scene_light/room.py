"""A room that is known: flat faces of what stands around, seen or not."""

import logging
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Self

import torch
from pydantic import BeforeValidator, Field, PositiveInt, model_validator
from torch import Tensor, nn

from tofcorr.errors import ConfigError
from tofcorr.files import open_regular
from tofcorr.options import Number, Options, PositiveNumber, one_line

_LOG = logging.getLogger(__name__)

_SIZES = 0.1, 300.0
"""Least and largest size of a room, metres. Chosen: a cupboard stated in millimetres and read as
metres is larger, a hall is not; and a hall that is scaled for nothing is smaller."""

Reflectivity = Annotated[Number, Field(gt=0, le=1)]


class Face(Options):
    """A flat part of a room.

    Attributes:
        corners: Of a convex polygon, in order, metres.
        reflectivity: Share of the light that it sends back, while no frame shows it.
    """

    corners: Annotated[tuple[tuple[Number, Number, Number], ...], Field(min_length=3)]
    reflectivity: Reflectivity = 0.5

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

    @classmethod
    def around(cls, points: Tensor, reflectivity: float = 0.5) -> tuple[Self, float]:
        """Return the hull of points on one plane (N, 3), metres, and its area, square metres."""
        from scipy.spatial import ConvexHull  # Slow to import.

        middle = points.mean(0)
        axes = torch.linalg.svd(points - middle, full_matrices=False).Vh[:2]
        flat = (points - middle) @ axes.T
        hull = ConvexHull(flat.numpy())
        corners = (middle + flat[hull.vertices.copy()] @ axes).tolist()
        return cls.model_validate({"corners": corners, "reflectivity": reflectivity}), hull.volume


class MeshFile(Options):
    """A room in a file of triangles: PLY, OBJ or STL. Triangles of one plane become one face.

    Attributes:
        file: Its path.
        scale: Metres of a unit of the file.
        reflectivity: Of all faces, while no frame shows them.
        most_faces: As many are kept, the largest.
    """

    file: str
    scale: PositiveNumber = 1.0
    reflectivity: Reflectivity = 0.5
    most_faces: PositiveInt = 200

    def faces(self) -> tuple[Face, ...]:
        """Read the file.

        Raises:
            ValueError: It cannot be read, holds no faces, or is of another size than rooms are.
        """
        try:
            import trimesh  # Slow to import, and not always there.
        except ImportError:
            raise ConfigError(f"{self.file} needs trimesh: pip install 'tofcorr[mesh]'") from None
        try:
            with open_regular(self.file) as file:
                mesh = trimesh.load_mesh(file, Path(self.file).suffix[1:].lower(), process=False)
        except Exception as error:  # noqa: BLE001 - the reader raises whatever bytes lead it to
            why = getattr(error, "strerror", None) or one_line(str(error))
            said = f"{self.file}: no readable PLY, OBJ or STL file ({why})"
            raise ConfigError(said) from None
        mesh.apply_scale(self.scale)
        low, high = _SIZES
        size = float(mesh.extents.max()) if len(mesh.faces) else math.nan
        if not low <= size <= high:
            said = f"{size:.3g} m; set `scale`, metres of a unit of the file"
            said = said if size >= 0 else "no triangles, or corners that are no numbers"
            raise ConfigError(f"{self.file}: expected a mesh of {low:g} to {high:g} m, got {said}")
        mesh.merge_vertices()
        mesh.update_faces(mesh.nondegenerate_faces())
        corners, areas = torch.tensor(mesh.triangles).double(), torch.tensor(mesh.area_faces)
        found, alone = list[tuple[float, Tensor]](), torch.ones_like(areas, dtype=torch.bool)
        for facet in mesh.facets:
            points, area = corners[facet].reshape(-1, 3), float(areas[facet].sum())
            # Of what is bent, or not convex, the triangles stay. Files hold single precision.
            if abs(Face.around(points)[1] - area) < torch.finfo(torch.float32).eps ** 0.5 * area:
                found.append((area, points))
                alone[facet] = False
        found += zip(areas[alone].tolist(), corners[alone], strict=True)
        found.sort(key=lambda one: -one[0])
        if len(kept := found[: self.most_faces]) < len(found):
            left = 100 * sum(area for area, _ in found[len(kept) :]) / float(areas.sum())
            said = f"the {len(kept)} largest of {len(found)} flat faces are used, without"
            _LOG.warning("%s: %s %.1f %% of the area (room.most_faces).", self.file, said, left)
        return tuple(Face.around(points, self.reflectivity)[0] for _, points in kept)


def _read(room: object) -> object:
    """Return the faces of a file that is named; anything else as it is."""
    named = {"file": room} if isinstance(room, str) else room
    if not isinstance(named, Mapping):
        return room
    return MeshFile.from_mapping(named, "the file of a room").faces()


Faces = Annotated[tuple[Face, ...], BeforeValidator(_read)]
"""Faces, or a `MeshFile` whose faces they are."""


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
