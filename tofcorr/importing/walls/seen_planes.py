"""The planes that all images saw, as arrays, in an order that does not depend on the images'."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from tofcorr.importing.walls.image_plane import ImagePlane


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
        names = ("image", "number", "normal", "points", "support", "world_from_tool")
        taken = replace(self, **{name: getattr(self, name)[chosen] for name in names})
        return taken if self.label is None else replace(taken, label=self.label[chosen])

    def may_be_one_wall(self) -> Tensor:
        """Return which pairs of planes may show one wall, shape (M, M): not two of one image."""
        pair = self.image[:, None] != self.image[None, :]
        return pair if self.label is None else pair & (self.label[:, None] == self.label[None, :])

    @property
    def rotation(self) -> Tensor:
        """Rotations world_from_tool, shape (M, 3, 3)."""
        return self.world_from_tool[:, :3, :3]

    @property
    def translation(self) -> Tensor:
        """Translations world_from_tool, shape (M, 3), metres."""
        return self.world_from_tool[:, :3, 3]


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
    every = [
        (image, number, plane)
        for image, own in enumerate(planes)
        for number, plane in enumerate(own)
    ]
    keys = [
        (world_from_tool[image].flatten().tolist(), plane.offset, plane.normal.tolist())
        for image, _, plane in every
    ]
    every = [every[k] for k in sorted(range(len(every)), key=keys.__getitem__)]
    image = torch.tensor([image for image, _, _ in every], dtype=torch.int64)
    return SeenPlanes(
        image=image,
        number=torch.tensor([number for _, number, _ in every], dtype=torch.int64),
        normal=_stacked([plane.normal for _, _, plane in every], (3,)),
        points=_stacked([plane.points for _, _, plane in every], (4, 3)),
        support=torch.tensor([plane.support / pixels for _, _, plane in every]).double(),
        world_from_tool=world_from_tool[image],
        label=None if labels is None else labels[image],
    )


def _stacked(tensors: list[Tensor], shape: tuple[int, ...]) -> Tensor:
    return torch.stack(tensors) if tensors else torch.zeros(0, *shape, dtype=torch.float64)
