"""The walls of a recording, named, and what is on none of them."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch
from torch import Tensor

from tofcorr.importing.report import Refusal
from tofcorr.importing.walls.image_plane import ImagePlane
from tofcorr.importing.walls.joint import Joint
from tofcorr.importing.walls.options import WallOptions
from tofcorr.importing.walls.seen_planes import SeenPlanes
from tofcorr.importing.walls.undetermined import undetermined

# A wall is called floor if its normal is this close to the world's z axis. Set by hand:
# robots stand more upright than that, and ramps are steeper.
_LEVEL = math.radians(5.0)


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
            "left_out": [{"view": one.view, "reason": one.reason} for one in self.left_out],
            "warnings": self.warnings,
        }


def summarise(
    options: WallOptions,
    images: Sequence[Sequence[ImagePlane]],
    planes: SeenPlanes,
    joint: Joint,
    given: np.ndarray | None,
) -> FoundWalls:
    """Name the walls in order of their pixels, and say what was left out."""
    support = torch.zeros(len(joint.walls), dtype=torch.float64)
    on_wall = joint.wall >= 0
    support.index_add_(0, joint.wall[on_wall], planes.support[on_wall])
    order = support.argsort(descending=True, stable=True)
    if given is not None:
        order = torch.arange(len(order))
    names = [str(name) for name in given] if given is not None else _names(joint, order, options)
    undecided = undetermined(planes, joint.reordered(order), names)
    if any("the tilt of floor" in direction for direction in undecided):
        names = _names(joint, order, options.model_copy(update={"up": "unknown"}))
        undecided = undetermined(planes, joint.reordered(order), names)
    rank = order.argsort()
    wall_of = torch.where(on_wall, rank[joint.wall.clamp(min=0)], -1)
    walls = [
        FoundWall(
            name=names[place],
            normal_world=joint.walls.normal[k].numpy(),
            offset=float(joint.walls.offset[k]),
            images=int((wall_of == place).sum()),
            share=float(planes.support[wall_of == place].mean()),
        )
        for place, k in enumerate(order.tolist())
    ]
    views = [
        WallView(
            image=int(planes.image[k]),
            wall=int(wall_of[k]),
            gradient=None
            if given is not None
            else images[int(planes.image[k])][int(planes.number[k])].gradient.numpy(),
        )
        for k in on_wall.nonzero()[:, 0].tolist()
    ]
    views.sort(key=lambda view: (view.image, view.wall))
    return FoundWalls(
        walls=walls,
        views=views,
        tool_from_camera=joint.tool_from_camera.numpy(),
        deviation_mm=1e3 * float(joint.deviation[on_wall].square().mean().sqrt()),
        undetermined=undecided,
        left_out=_left_out(images, planes, joint, options),
        warnings=_warnings(undecided),
    )


def _names(joint: Joint, order: Tensor, options: WallOptions) -> list[str]:
    """Number the walls; the lowest horizontal one is the floor."""
    level = joint.walls.normal[:, 2] > math.cos(_LEVEL)
    floor = -1
    if options.up == "z" and bool(level.any()):
        # A horizontal wall's height is -d.
        floor = int(torch.where(level, joint.walls.offset, -torch.inf).argmax())
    names, count = [], 0
    for k in order.tolist():
        count += k != floor
        names.append("floor" if k == floor else f"wall {count}")
    return names


def _left_out(
    images: Sequence[Sequence[ImagePlane]], planes: SeenPlanes, joint: Joint, options: WallOptions
) -> list[Refusal]:
    on_wall = set(planes.image[joint.wall >= 0].tolist())
    found = [
        Refusal(
            view=f"image {k}",
            reason="nothing flat covers "
            f"{100 * options.least_share:g} % of it to within {options.tolerance_mm:g} mm"
            if not own
            else "none of its planes is on a wall",
        )
        for k, own in enumerate(images)
        if k not in on_wall
    ]
    for k in (joint.wall < 0).nonzero()[:, 0].tolist():
        off = float(joint.deviation[k])
        reason = (
            f"{1e3 * off:.0f} mm from the nearest wall" if math.isfinite(off) else "faces no wall"
        )
        name = f"image {int(planes.image[k])}, plane {int(planes.number[k]) + 1}"
        found.append(Refusal(view=name, reason=f"{reason}, or not seen in enough images"))
    return sorted(found, key=lambda one: int(one.view.split()[1].rstrip(",")))


def _warnings(undecided: list[str]) -> list[str]:
    if not undecided:
        return []
    return [
        f"The images do not determine: {'; '.join(undecided)}. There the recording holds the "
        "recorded guess and no measurement. Turn the camera about two axes before the walls, and "
        "roll it."
    ]
