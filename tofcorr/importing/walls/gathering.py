"""The planes that all images saw, and how they are gathered into walls of the world.

The hand-eye transform is then known to some centimetres; `hand_eye` finds it.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from tofcorr.importing.walls.image_planes import ImagePlane

TYPICAL = 0.01
"""What an uncalibrated camera's error typically measures, metres, beside a constant and a slope:
the standard deviation of a plane's place. Widths below are multiples of it."""

TILT = math.radians(4.0)
"""The tilt that a camera's error gives a plane: twice that between two normals of one wall, three
times where the hand-eye is known to some degrees only."""


@dataclass(frozen=True)
class SeenPlanes:
    """Planes in the frame of the camera that saw them, and the pose it saw them from.

    Attributes:
        image: The image of each plane, shape (M,).
        number: Its number among the planes of its image, shape (M,).
        normal: Unit normals towards the camera, camera frame, shape (M, 3).
        points: Points that stand for the plane, camera frame, shape (M, P, 3), metres.
        support: Share of the image's pixels, shape (M,).
        world_from_tool: The pose of each plane's image, shape (M, 4, 4).
        label: The wall of each plane where it is known, shape (M,), counted from zero; None: not
            known.
    """

    image: Tensor
    number: Tensor
    normal: Tensor
    points: Tensor
    support: Tensor
    world_from_tool: Tensor
    label: Tensor | None = None

    def __len__(self) -> int:
        """Return the number of planes."""
        return len(self.image)

    def take(self, chosen: Tensor) -> "SeenPlanes":
        """Return some of the planes, by number or by mask."""
        return SeenPlanes(
            image=self.image[chosen],
            number=self.number[chosen],
            normal=self.normal[chosen],
            points=self.points[chosen],
            support=self.support[chosen],
            world_from_tool=self.world_from_tool[chosen],
            label=None if self.label is None else self.label[chosen],
        )

    def may_be_one_wall(self) -> Tensor:
        """Return which pairs of planes may show one wall, shape (M, M): not two of one image."""
        pair = self.image[:, None] != self.image
        return pair if self.label is None else pair & (self.label[:, None] == self.label)

    @property
    def rotation(self) -> Tensor:
        """Rotations world_from_tool, shape (M, 3, 3)."""
        return self.world_from_tool[:, :3, :3]

    def in_world(self, tool_from_camera: Tensor) -> tuple[Tensor, Tensor]:
        """Return points (M, P, 3), metres, and normals (M, 3) in the world."""
        pose = self.world_from_tool @ tool_from_camera
        rotation = pose[:, :3, :3]
        points = self.points @ rotation.transpose(1, 2) + pose[:, None, :3, 3]
        return points, (rotation @ self.normal[:, :, None])[:, :, 0]


class WallPlanes(NamedTuple):
    """Planes n . x + d = 0 of the world: normals (G, 3) towards the camera, offsets (G,) in m."""

    normal: Tensor
    offset: Tensor


def seen_planes(
    planes: Sequence[Sequence[ImagePlane]],
    world_from_tool: Tensor,
    pixels: int,
    labels: Tensor | None = None,
) -> SeenPlanes:
    """Gather the planes of all images, sorted by what was measured and not by the images' numbers.

    Args:
        planes: The planes of each image.
        world_from_tool: The images' poses, shape (N, 4, 4).
        pixels: Pixels of an image.
        labels: The wall that each image shows, shape (N,); None: not known.
    """
    every = [(i, k, plane) for i, own in enumerate(planes) for k, plane in enumerate(own)]
    pose = world_from_tool.flatten(1).tolist()
    every.sort(key=lambda one: (pose[one[0]], one[2].offset, one[2].normal.tolist()))
    image = torch.tensor([i for i, _, _ in every], dtype=torch.int64)
    empty = torch.zeros(0, 3, dtype=torch.float64)
    return SeenPlanes(
        image=image,
        number=torch.tensor([k for _, k, _ in every], dtype=torch.int64),
        normal=torch.stack([plane.normal for *_, plane in every]) if every else empty,
        points=torch.stack([plane.points for *_, plane in every]) if every else empty[:, None],
        support=torch.tensor([plane.support / pixels for *_, plane in every]).double(),
        world_from_tool=world_from_tool[image],
        label=None if labels is None else labels[image],
    )


def distances(planes: SeenPlanes, tool_from_camera: Tensor, walls: WallPlanes) -> Tensor:
    """Return how far each plane is from each wall, shape (M, G), metres; infinite if turned away.

    The distance is the root mean square of its points' distances.
    """
    return _distances(*planes.in_world(tool_from_camera), walls)


def _distances(points: Tensor, normal: Tensor, walls: WallPlanes) -> Tensor:
    off = torch.einsum("mpa,ga->mpg", points, walls.normal) + walls.offset
    facing = normal @ walls.normal.T > math.cos(3 * TILT)
    return torch.where(facing, off.square().mean(dim=1).sqrt(), torch.inf)


def gather(planes: SeenPlanes, tool_from_camera: Tensor, fewest: int) -> WallPlanes:
    """Gather planes of many images into walls, that of most images first.

    Args:
        planes: The planes.
        tool_from_camera: The hand-eye transform (4, 4), known to some centimetres.
        fewest: Images that make a wall; planes whose walls are known make one each.
    """
    points, normal = planes.in_world(tool_from_camera)
    if planes.label is not None:
        known = [planes.label == k for k in range(int(planes.label.max()) + 1)]
        return _walls([_plane_of(points[k], normal[k], planes.support[k]) for k in known])
    left = torch.ones(len(planes), dtype=torch.bool)
    found: list[tuple[Tensor, Tensor]] = []
    near = 6 * TYPICAL
    while int(left.sum()) >= fewest:
        # Of a wall that a tenth of the planes show, thirty of 300 propose it. A single image's own
        # error comes on top.
        seeds = left.nonzero()[:, 0]
        seeds = seeds[torch.linspace(0, len(seeds) - 1, min(len(seeds), 300)).long()]
        offset = -(points[seeds].mean(dim=1) * normal[seeds]).sum(dim=1)
        close = _distances(points, normal, WallPlanes(normal[seeds], offset)) < near + 2 * TYPICAL
        # The most planes; between equals the larger ones.
        close &= left[:, None]
        best = int((close * (1 + 1e-3 * planes.support[:, None])).sum(dim=0).argmax())
        members, wall = close[:, best], (normal[seeds[best]], offset[best])
        for _ in range(3):  # The choice hardly changes after the first.
            wall = _plane_of(points[members], normal[members], planes.support[members])
            members = left & (_distances(points, normal, _walls([wall]))[:, 0] < near)
            if not bool(members.any()):
                break
        if len(planes.image[members].unique()) < fewest:
            # No other wall has more images than this one.
            break
        found.append(wall)
        left &= ~members
    return _walls(found)


def _walls(planes: Sequence[tuple[Tensor, Tensor]]) -> WallPlanes:
    if not planes:
        return WallPlanes(torch.zeros(0, 3).double(), torch.zeros(0).double())
    return WallPlanes(*(torch.stack(part) for part in zip(*planes, strict=True)))


def _plane_of(points: Tensor, normal: Tensor, weight: Tensor) -> tuple[Tensor, Tensor]:
    """Fit a plane to the points of planes (M, P, 3); each plane's own normal counts as well."""
    share = weight / weight.sum()
    mean = (share[:, None] * points.mean(dim=1)).sum(dim=0)
    centred = points - mean
    second = torch.einsum("m,mpa,mpb->ab", share, centred, centred) / points.shape[1]
    facing = torch.nn.functional.normalize((share[:, None] * normal).sum(dim=0), dim=0)
    vector = torch.linalg.eigh(second).eigenvectors[:, 0]
    vector = vector * torch.where(vector @ facing < 0, -1.0, 1.0)
    # Points along a line leave a turn open: there the images' own normals decide.
    if float(vector @ facing) < math.cos(3 * TILT):
        vector = facing
    return vector, -(mean @ vector)
