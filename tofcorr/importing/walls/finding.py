"""Walls of images from known robot poses, without measured planes: found, named and reported."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import torch

from tofcorr.errors import CalibrationDataError
from tofcorr.importing.run import Refusal
from tofcorr.importing.walls.gathering import SeenPlanes, WallPlanes, seen_planes
from tofcorr.importing.walls.hand_eye import Joint, match, match_single_ray, undetermined
from tofcorr.importing.walls.image_planes import ImagePlane, WallOptions

_FEWEST_IMAGES = 4
"""With fewer images nothing is found: the rotation of the hand-eye and a wall's normal have five
unknowns, and each image gives two; three images determine them, and the fourth is the check."""


@dataclass(frozen=True, kw_only=True)
class FoundWall:
    """One wall, as estimated.

    Attributes:
        name: `wall 1` is the one of most pixels; or what the recording called it.
        normal_world: Unit normal towards the camera, shape (3,).
        offset: d of n . x + d = 0, metres.
        images: How many images show it.
        share: Share of those images' pixels that lie on it.
    """

    name: str
    normal_world: np.ndarray
    offset: float
    images: int
    share: float


@dataclass(frozen=True, kw_only=True)
class WallView:
    """One image of one wall.

    Attributes:
        image: Number of the image.
        wall: Number of the wall.
        gradient: The plane g . x = 1 fitted in the image, camera frame, shape (3,); None: every
            pixel looks at the wall.
    """

    image: int
    wall: int
    gradient: np.ndarray | None


@dataclass(frozen=True, kw_only=True)
class FoundWalls:
    """What was found in a recording.

    Attributes:
        walls: The walls.
        views: Which images show which walls, by image and then by wall.
        tool_from_camera: The hand-eye transform that goes with the walls, shape (4, 4): a start.
        deviation_mm: Root mean square distance of the planes of single images from their walls.
        undetermined: Directions of hand-eye and walls that the images do not determine, by name.
        left_out: Images, and planes of images, that are on no wall, and why.
        warnings: Sentences for people.
    """

    walls: list[FoundWall]
    views: list[WallView]
    tool_from_camera: np.ndarray
    deviation_mm: float
    undetermined: list[str]
    left_out: list[Refusal]
    warnings: list[str] = field(default_factory=list)

    def planes(self) -> WallPlanes:
        """Return the walls as planes of the world."""
        normals = np.stack([wall.normal_world for wall in self.walls])
        offsets = [wall.offset for wall in self.walls]
        return WallPlanes(torch.from_numpy(normals), torch.tensor(offsets).double())

    def to_mapping(self) -> dict[str, Any]:
        """Return the walls, and what was left out, for a report."""
        return {
            "walls": [
                {
                    "name": wall.name,
                    "normal_world": wall.normal_world.tolist(),
                    "offset_m": wall.offset,
                    "images": wall.images,
                    "share": wall.share,
                }
                for wall in self.walls
            ],
            "tool_from_camera": self.tool_from_camera.tolist(),
            "deviation_mm": self.deviation_mm,
            "undetermined": self.undetermined,
            "left_out": [one._asdict() for one in self.left_out],
            "warnings": self.warnings,
        }


def walls_of_planes(
    images: Sequence[Sequence[ImagePlane]],
    pixels: int,
    world_from_tool: np.ndarray,
    guess: np.ndarray,
    options: WallOptions,
    origin: str,
    targets: np.ndarray | None = None,
) -> FoundWalls:
    """Find the walls that the planes of images from known robot poses show.

    Args:
        images: The planes of each image, as `planes_of_image` finds them.
        pixels: Pixels of an image.
        world_from_tool: The images' poses, shape (N, 4, 4), metres.
        guess: A hand-eye transform (4, 4); it decides only what the images leave open.
        options: How planes were found, and are matched.
        origin: Where the images come from, for messages.
        targets: The name of the one wall that each image shows, shape (N,); None: walls are looked
            for.

    Raises:
        CalibrationDataError: No robot moves, or there is no wall in the images.
    """
    if (world_from_tool == world_from_tool[0]).all():
        raise CalibrationDataError(
            f"{origin}: walls are found in images from several robot poses, and "
            "world_from_tool is the same for every image. Give the robot's poses."
        )
    names = labels = None
    if targets is not None:
        names, index = np.unique(targets, return_inverse=True)
        labels = torch.from_numpy(index)
    planes = seen_planes(images, torch.from_numpy(np.array(world_from_tool)), pixels, labels)
    if names is not None and planes.label is not None:
        # A wall without a single measurement has no place.
        used, label = torch.unique(planes.label, return_inverse=True)
        names, planes = names[used.numpy()], replace(planes, label=label)
    seeing = len(planes.image.unique())
    if seeing < _FEWEST_IMAGES:
        raise CalibrationDataError(
            f"{origin}: {seeing} of {len(images)} images show anything flat, {_FEWEST_IMAGES} are "
            f"needed; a plane must cover {100 * options.least_share:g} % of an image to within "
            f"{options.tolerance_mm:g} mm."
        )
    start = torch.from_numpy(np.array(guess))
    if pixels == 1:
        joint = match_single_ray(planes, start)
    else:
        joint = match(planes, start, options.fewest_images)
    if not bool((joint.wall >= 0).any()):
        raise CalibrationDataError(
            f"{origin}: {len(planes)} planes were found in {len(images)} images, and no hand-eye "
            f"transform makes those of {options.fewest_images} images one wall. Do the poses "
            "belong to the images, and are they world_from_tool in metres?"
        )
    return _summarised(options, images, planes, joint, names)


def _summarised(
    options: WallOptions,
    images: Sequence[Sequence[ImagePlane]],
    planes: SeenPlanes,
    joint: Joint,
    given: np.ndarray | None,
) -> FoundWalls:
    """Name the walls in order of their pixels, and say what was left out."""
    on_wall = joint.wall >= 0
    if given is None:
        support = torch.zeros(len(joint.walls.offset), dtype=torch.float64)
        support.index_add_(0, joint.wall[on_wall], planes.support[on_wall])
        joint = joint.reordered(support.argsort(descending=True, stable=True))
    names = _names(joint.walls, options.up) if given is None else [str(name) for name in given]
    undecided = undetermined(planes, joint, names)
    if any("the tilt of floor" in direction for direction in undecided):
        names = _names(joint.walls, "unknown")
        undecided = undetermined(planes, joint, names)
    walls = [
        FoundWall(
            name=name,
            normal_world=joint.walls.normal[k].numpy(),
            offset=float(joint.walls.offset[k]),
            images=int((joint.wall == k).sum()),
            share=float(planes.support[joint.wall == k].mean()),
        )
        for k, name in enumerate(names)
    ]
    views = []
    for k in on_wall.nonzero()[:, 0].tolist():
        image, number = int(planes.image[k]), int(planes.number[k])
        gradient = images[image][number].gradient.numpy() if given is None else None
        views.append(WallView(image=image, wall=int(joint.wall[k]), gradient=gradient))
    warning = (
        f"The images do not determine: {'; '.join(undecided)}. There the recording holds the "
        "recorded guess and no measurement. Turn the camera about two axes before the walls, and "
        "roll it."
    )
    return FoundWalls(
        walls=walls,
        views=sorted(views, key=lambda view: (view.image, view.wall)),
        tool_from_camera=joint.tool_from_camera.numpy(),
        deviation_mm=1e3 * float(joint.deviation[on_wall].square().mean().sqrt()),
        undetermined=undecided,
        left_out=_left_out(images, planes, joint, options),
        warnings=[warning] if undecided else [],
    )


def _names(walls: WallPlanes, up: str) -> list[str]:
    """Number the walls; the lowest horizontal one is the floor if z points up.

    Its normal is within 5 degrees of z: robots stand more upright, and ramps are steeper.
    """
    level = walls.normal[:, 2] > math.cos(math.radians(5))
    floor = -1
    if up == "z" and bool(level.any()):
        # A horizontal wall's height is -d.
        floor = int(torch.where(level, walls.offset, -torch.inf).argmax())
    others = (f"wall {number}" for number in range(1, len(walls.offset) + 1))
    return ["floor" if k == floor else next(others) for k in range(len(walls.offset))]


def _left_out(
    images: Sequence[Sequence[ImagePlane]], planes: SeenPlanes, joint: Joint, options: WallOptions
) -> list[Refusal]:
    on_wall = set(planes.image[joint.wall >= 0].tolist())
    found = []
    for k, own in enumerate(images):
        if k not in on_wall:
            reason = "none of its planes is on a wall"
            if not own:
                share = f"{100 * options.least_share:g} %"
                reason = f"nothing flat covers {share} of it to within {options.tolerance_mm:g} mm"
            found.append((k, Refusal(f"image {k}", reason)))
    for k in (joint.wall < 0).nonzero()[:, 0].tolist():
        off, image = float(joint.deviation[k]), int(planes.image[k])
        far = f"{1e3 * off:.0f} mm from the nearest wall" if math.isfinite(off) else "faces no wall"
        name = f"image {image}, plane {int(planes.number[k]) + 1}"
        found.append((image, Refusal(name, f"{far}, or not seen in enough images")))
    return [refusal for _, refusal in sorted(found, key=lambda one: one[0])]
