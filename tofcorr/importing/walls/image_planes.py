"""The large planes of depth images, by sequential RANSAC, and the pixels that lie on them.

On the plane g . x = 1 the inverse distance is linear in the ray, 1 / D = g . ray, so that each fit
is a linear one. The search looks at a thinned image; all pixels are assigned afterwards.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import torch
from pydantic import Field, PositiveFloat, PositiveInt
from torch import Tensor

from tofcorr.estimation.moments import Parameters
from tofcorr.estimation.robust import deviation, fit_plane, largest_plane
from tofcorr.options import Options

_SEARCHED_PIXELS = 5_000
"""The search sees about this many pixels: enough for planes of 5 % of the image, and quick."""

_HYPOTHESES = 300
"""Hypotheses a plane. Half draw their pixels close together: of a plane on 5 % of the image a
triple from everywhere has all three with probability 1e-4, a triple of neighbours with 4 %."""


class WallOptions(Options):
    """How walls are found in depth images and matched between them.

    Attributes:
        tolerance_mm: How far a pixel's distance may be from its plane's, along the ray. It leaves
            room for the error of a camera that is not calibrated yet. Two planes of one image are
            told apart if they are more than twice this tolerance apart.
        least_share: Smallest share of an image's pixels that makes a plane.
        most_planes: Largest number of planes taken from one image, the largest first.
        fewest_images: A wall that fewer images show is left out.
    """

    tolerance_mm: PositiveFloat = 30.0
    least_share: float = Field(default=0.05, gt=0.0, lt=1.0)
    most_planes: PositiveInt = 6
    fewest_images: int = Field(default=6, ge=3)


class ImagePlane(NamedTuple):
    """One plane of an image, in the camera frame.

    Attributes:
        normal: Unit normal towards the camera, shape (3,).
        offset: Distance of the camera from the plane, metres: normal . x + offset = 0.
        support: Pixels of the image that lie on it.
        points: Four points that have the mean and the second moments of the measured ones,
            shape (4, 3), metres: they say as much of the plane's place as all pixels. One point of
            a sensor of one pixel.
    """

    normal: Tensor
    offset: float
    support: int
    points: Tensor


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
        parts = {name: part for name, part in vars(self).items() if part is not None}
        return SeenPlanes(**{name: part[chosen] for name, part in parts.items()})

    def may_be_one_wall(self) -> Tensor:
        """Return which pairs of planes may show one wall, shape (M, M): not two of one image."""
        pair = self.image[:, None] != self.image
        return pair if self.label is None else pair & (self.label[:, None] == self.label)

    @property
    def gradient(self) -> Tensor:
        """The vectors g of the planes g . x = 1, shape (M, 3), per metre."""
        return self.normal / (self.normal * self.points.mean(dim=1)).sum(dim=1, keepdim=True)

    @property
    def rotation(self) -> Tensor:
        """Rotations world_from_tool, shape (M, 3, 3)."""
        return self.world_from_tool[:, :3, :3]

    def in_world(self, parameters: Parameters) -> tuple[Tensor, Tensor]:
        """Return points (M, P, 3), metres, the camera's error taken off, and normals in the world.

        Args:
            parameters: The hand-eye transform; a constant and a slope of the error.
        """
        constant, slope = parameters.coefficients
        distance = self.points.norm(dim=2, keepdim=True)
        points = self.points * (1 - slope - constant / distance)
        pose = self.world_from_tool @ parameters.tool_from_camera
        normal = (pose[:, :3, :3] @ self.normal[:, :, None])[:, :, 0]
        return points @ pose[:, :3, :3].mT + pose[:, None, :3, 3], normal


def seen_planes(
    planes: Sequence[Sequence[ImagePlane]],
    world_from_tool: Tensor,
    pixels: int,
    labels: Tensor | None = None,
) -> SeenPlanes:
    """Put the planes of all images together, sorted by what was measured, not by images' numbers.

    Args:
        planes: The planes of each image, some of which have any.
        world_from_tool: The images' poses, shape (N, 4, 4).
        pixels: Pixels of an image.
        labels: The wall that each image shows, shape (N,); None: not known.
    """
    every = [(i, k, plane) for i, own in enumerate(planes) for k, plane in enumerate(own)]
    pose = world_from_tool.flatten(1).tolist()
    every.sort(key=lambda one: (pose[one[0]], one[2].offset, one[2].normal.tolist()))
    image = torch.tensor([i for i, _, _ in every], dtype=torch.int64)
    return SeenPlanes(
        image=image,
        number=torch.tensor([k for _, k, _ in every], dtype=torch.int64),
        normal=torch.stack([plane.normal for *_, plane in every]),
        points=torch.stack([plane.points for *_, plane in every]),
        support=torch.tensor([plane.support / pixels for *_, plane in every]).double(),
        world_from_tool=world_from_tool[image],
        label=None if labels is None else labels[image],
    )


def planes_of_image(
    distance: Tensor,
    valid: Tensor,
    rays: Tensor,
    options: WallOptions,
    *,
    named: bool = False,
    seed: int = 0,
) -> list[ImagePlane]:
    """Find the planes of one image, the largest first.

    Args:
        distance: Along the ray, shape (H, W), metres; undefined where not `valid`.
        valid: Where there is a measurement, shape (H, W).
        rays: Unit rays, shape (H, W, 3).
        options: Tolerance and least size.
        named: Whether the image shows one wall and nothing else.
        seed: Of the hypotheses; the same for every image, so that an image's planes do not depend
            on its number.
    """
    if named:  # A sensor of one pixel sees no normal: it is put opposite to the ray.
        ray, measured = rays[valid].double(), distance[valid].double()
        if len(measured) < min(3, valid.numel()):
            return []
        if valid.numel() == 1:
            return [ImagePlane(-ray[0], float(measured[0]), 1, ray * measured[:, None])]
        gradient = fit_plane(ray, measured[None], torch.ones(1, len(measured)).bool())[0]
        return [described(rays, valid, gradient)]
    step = max(1, math.isqrt(distance.numel() // _SEARCHED_PIXELS))
    start = step // 2
    seen = valid[start::step, start::step]
    ray = rays[start::step, start::step][seen].double()
    measured = distance[start::step, start::step][seen].double()
    generator = torch.Generator().manual_seed(seed)
    least, tolerance = options.least_share * seen.numel(), options.tolerance_mm / 1000
    left = torch.ones(len(measured), dtype=torch.bool)
    gradients: list[Tensor] = []
    while len(gradients) < options.most_planes and int(left.sum()) >= max(least, 3):
        triples = _triples(seen, left, least, generator)
        gradient = largest_plane(ray[left], measured[left], tolerance, generator, triples)
        if gradient is None:
            break
        off = deviation(ray, measured[None], gradient[None])[0].abs()
        if _dense(seen, left & (off <= tolerance)) < least:
            break
        gradients.append(gradient)
        # The edge of a wall that the camera's error bends is not a second wall.
        left &= off > 2 * tolerance
    if not gradients:
        return []
    masks = plane_masks(distance, valid, rays, torch.stack(gradients), tolerance)
    planes = [
        described(rays, mask, gradient)
        for mask, gradient in zip(masks, gradients, strict=True)
        if int(mask.sum()) >= options.least_share * distance.numel()
    ]
    return sorted(planes, key=lambda plane: -plane.support)


def plane_masks(
    distance: Tensor, valid: Tensor, rays: Tensor, gradients: Tensor, tolerance: float
) -> Tensor:
    """Return which pixels lie on which plane, shape (K, H, W).

    A pixel near the line where two planes meet lies on neither: both explain it.

    Args:
        distance: Along the ray, shape (H, W), metres.
        valid: Where there is a measurement, shape (H, W).
        rays: Unit rays, shape (H, W, 3).
        gradients: The planes g . x = 1, shape (K, 3).
        tolerance: Largest deviation along the ray, metres.
    """
    inverse = rays.flatten(0, 1).to(torch.float32) @ gradients.to(torch.float32).T
    fitted = torch.where(inverse > 0, 1 / inverse, torch.inf).T.unflatten(1, distance.shape)
    near = valid & ((fitted - distance.to(torch.float32)).abs() <= tolerance)
    return near & (near.sum(dim=0) == 1)


def described(rays: Tensor, mask: Tensor, gradient: Tensor) -> ImagePlane:
    """Describe the plane g . x = 1 that was fitted to the pixels of a mask (H, W).

    About 20 000 of them do: noise of 10 mm then moves the plane by 0.1 mm.
    """
    used = mask.flatten().nonzero()[:, 0]
    direction = rays.flatten(0, 1)[used[:: max(1, len(used) // 20_000)]].double()
    points = direction / (direction @ gradient)[:, None]
    mean = points.mean(dim=0)
    values, vectors = torch.linalg.eigh((points - mean).T @ (points - mean) / len(points))
    # Two pairs, each 2^(1/2) standard deviations either side of the mean: the same moments.
    arms = (vectors[:, 1:] * (2 * values[1:].clamp(min=0)).sqrt()).T
    length = float(gradient.norm())
    four = mean + torch.cat([arms, -arms])
    return ImagePlane(-gradient / length, 1 / length, len(used), four)


def _triples(seen: Tensor, left: Tensor, least: float, generator: torch.Generator) -> Tensor:
    """Draw triples of the pixels left, by number, shape (T, 3): half anywhere, half close together.

    Those are within the side of a square of the `least` pixels that make a plane.
    """
    half, size, places = _HYPOTHESES // 2, torch.tensor(seen.shape), seen.nonzero()[left]
    anywhere = torch.randint(len(places), (half, 3), generator=generator)
    first = torch.randint(len(places), (half, 1), generator=generator)
    reach = max(1, round(math.sqrt(least)))
    shift = torch.randint(-reach, reach + 1, (half, 2, 2), generator=generator)
    number = torch.full(seen.shape, -1)
    number[tuple(places.T)] = torch.arange(len(places))
    others = number[(places[first] + shift).clamp(min=0).minimum(size - 1).unbind(-1)]
    near = torch.cat([first, others], dim=1)[(others >= 0).all(dim=1)]
    return torch.cat([anywhere, near])


def _dense(seen: Tensor, on_plane: Tensor) -> int:
    """Count the pixels on a plane of whose neighbours with a return 60 % lie on it as well.

    A plane that cuts through other surfaces has thin strips only.
    """
    image = torch.zeros(2, 1, *seen.shape)
    image[0, 0][seen], image[1, 0][seen] = on_plane.float(), 1.0
    share = torch.nn.functional.avg_pool2d(image, 3, stride=1, padding=1)[:, 0]
    return int((on_plane & (5 * share[0] >= 3 * share[1])[seen]).sum())
