"""Planes gathered into walls, the hand-eye being known to some centimetres."""

import math
from typing import NamedTuple

import torch
from torch import Tensor

from tofcorr.importing.walls.seen_planes import SeenPlanes

# A plane belongs to a wall if its points are this near it (metres, root mean square) and it is
# turned by less than this: the error of a camera that is not calibrated yet.
NEAR = 0.06
_TURNED = math.radians(12.0)
# The same (metres) where a wall is proposed by a single image, whose own error comes on top. Set by
# hand.
_NEAR_SEED = 0.08
# Planes that propose a wall, at most. Set by hand: of a wall that a tenth of the planes show,
# thirty propose it.
_MOST_SEEDS = 300
# How often a wall is fitted to its planes, and they are chosen anew. Set by hand: the choice hardly
# changes after the first.
_REFITS = 3


class WallPlanes(NamedTuple):
    """Planes n . x + d = 0 of the world: normals (G, 3) towards the camera, offsets (G,) in m."""

    normal: Tensor
    offset: Tensor

    def __len__(self) -> int:  # type: ignore[override]
        """Return the number of walls."""
        return len(self.offset)


def points_in_world(planes: SeenPlanes, tool_from_camera: Tensor) -> Tensor:
    """Return the planes' points in the world, shape (M, P, 3), metres."""
    pose = planes.world_from_tool @ tool_from_camera
    return planes.points @ pose[:, :3, :3].transpose(1, 2) + pose[:, None, :3, 3]


def distances(planes: SeenPlanes, tool_from_camera: Tensor, walls: WallPlanes) -> Tensor:
    """Return how far each plane is from each wall, shape (M, G), metres; infinite if turned away.

    The distance is the root mean square of its points' distances.
    """
    return _distances(*_in_world(planes, tool_from_camera), walls)


def gather(planes: SeenPlanes, tool_from_camera: Tensor, fewest: int) -> WallPlanes:
    """Gather planes of many images into walls, that of most images first.

    Args:
        planes: The planes.
        tool_from_camera: The hand-eye transform, shape (4, 4).
        fewest: Images that make a wall.
    """
    points, normal = _in_world(planes, tool_from_camera)
    if planes.label is not None:
        return _labelled(points, normal, planes.support, planes.label)
    left = torch.ones(len(planes), dtype=torch.bool)
    found: list[tuple[Tensor, Tensor]] = []
    while int(left.sum()) >= fewest:
        seeds = left.nonzero()[:, 0]
        seeds = seeds[torch.linspace(0, len(seeds) - 1, min(len(seeds), _MOST_SEEDS)).long()]
        offset = -(points[seeds].mean(dim=1) * normal[seeds]).sum(dim=1)
        own = _distances(points[left], normal[left], WallPlanes(normal[seeds], offset))
        # The most planes; between equals the larger ones.
        best = int(
            ((own < _NEAR_SEED) * (1 + 1e-3 * planes.support[left, None])).sum(dim=0).argmax()
        )
        wall = WallPlanes(normal[seeds[best]][None], offset[best][None])
        members = left & (_distances(points, normal, wall)[:, 0] < _NEAR_SEED)
        for _ in range(_REFITS):
            wall = _plane_of(points[members], normal[members], planes.support[members])
            members = left & (_distances(points, normal, wall)[:, 0] < NEAR)
            if not bool(members.any()):
                break
        if len(planes.image[members].unique()) < fewest:
            # No other wall has more images than this one.
            break
        found.append((wall.normal[0], wall.offset[0]))
        left &= ~members
    if not found:
        return WallPlanes(torch.zeros(0, 3).double(), torch.zeros(0).double())
    return WallPlanes(torch.stack([n for n, _ in found]), torch.stack([d for _, d in found]))


def _labelled(points: Tensor, normal: Tensor, support: Tensor, label: Tensor) -> WallPlanes:
    walls = [
        _plane_of(points[label == k], normal[label == k], support[label == k])
        for k in range(int(label.max()) + 1)
    ]
    return WallPlanes(
        torch.cat([wall.normal for wall in walls]), torch.cat([wall.offset for wall in walls])
    )


def _in_world(planes: SeenPlanes, tool_from_camera: Tensor) -> tuple[Tensor, Tensor]:
    rotation = (planes.world_from_tool @ tool_from_camera)[:, :3, :3]
    normal = (rotation @ planes.normal[:, :, None])[:, :, 0]
    return points_in_world(planes, tool_from_camera), normal


def _distances(points: Tensor, normal: Tensor, walls: WallPlanes) -> Tensor:
    off = torch.einsum("mpa,ga->mpg", points, walls.normal) + walls.offset
    distance = off.square().mean(dim=1).sqrt()
    return torch.where(normal @ walls.normal.T > math.cos(_TURNED), distance, torch.inf)


def _plane_of(points: Tensor, normal: Tensor, weight: Tensor) -> WallPlanes:
    """Fit a plane to the points of planes (M, P, 3); each plane's own normal counts as well."""
    share = weight / weight.sum()
    mean = (share[:, None] * points.mean(dim=1)).sum(dim=0)
    centred = points - mean
    second = torch.einsum("m,mpa,mpb->ab", share, centred, centred) / points.shape[1]
    facing = torch.nn.functional.normalize((share[:, None] * normal).sum(dim=0), dim=0)
    vector = torch.linalg.eigh(second).eigenvectors[:, 0]
    vector = vector * torch.where(vector @ facing < 0, -1.0, 1.0)
    # Points along a line leave a turn open: there the images' own normals decide.
    if float(vector @ facing) < math.cos(_TURNED):
        vector = facing
    return WallPlanes(vector[None], -(mean @ vector)[None])
