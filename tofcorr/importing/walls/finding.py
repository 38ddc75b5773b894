"""Walls of images from known robot poses, without measured planes: found, named and reported."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import numpy as np
import torch

from tofcorr.errors import CalibrationDataError
from tofcorr.importing.walls.hand_eye import TYPICAL, Joint, match, match_single_ray
from tofcorr.importing.walls.image_planes import ImagePlane, SeenPlanes, WallOptions, seen_planes


@dataclass(frozen=True, kw_only=True)
class FoundWalls:
    """What was found in a recording: G walls, and V views of one wall in one image.

    Attributes:
        names: `wall 1` is the one of most pixels; or what the recording called it.
        walls: Unit normal towards the camera, and d of n . x + d = 0 in metres, shape (G, 4).
        image: The image of each view, shape (V,), increasing.
        wall: Its wall, shape (V,).
        gradient: Its plane g . x = 1 fitted in the image, camera frame, shape (V, 3); None: every
            pixel looks at the wall.
        tool_from_camera: The hand-eye transform that goes with the walls, shape (4, 4): a start.
        error: A constant (metres) and a slope of the camera's error that go with it, shape (2,).
        deviation_mm: Root mean square distance of the planes of single images from their walls.
        misfit_mm: The same where each plane counts 60 mm at most, and on no wall that much.
        left_out: Why images, and planes of images, are on no wall, by their names.
    """

    OFF_WALL_MM: ClassVar[float] = 6000 * TYPICAL
    """What a plane that lies on no wall counts: the nearness at which planes are gathered."""
    SUSPICIOUS_MM: ClassVar[float] = 2000 * TYPICAL
    """Misfit from which a mistake is suspected: twice what an uncalibrated camera leaves."""
    names: list[str]
    walls: np.ndarray
    image: np.ndarray
    wall: np.ndarray
    gradient: np.ndarray | None
    tool_from_camera: np.ndarray
    error: np.ndarray
    deviation_mm: float
    misfit_mm: float
    left_out: dict[str, str]

    def measured(self, planes: Mapping[str, np.ndarray]) -> "FoundWalls":
        """Return the walls where they were measured, with normals towards the camera as found.

        Args:
            planes: (nx, ny, nz, d) by the wall's name, the normal of any length and sense.
        """
        given = np.array([planes[name] / np.linalg.norm(planes[name][:3]) for name in self.names])
        away = (given[:, :3] * self.walls[:, :3]).sum(axis=1, keepdims=True) < 0
        return replace(self, walls=np.where(away, -given, given))

    def to_mapping(self) -> dict[str, Any]:
        """Return the walls for a report."""
        each = zip(self.names, self.walls.tolist(), strict=True)
        return {
            "walls": [{"name": k, "normal_world": w[:3], "offset_m": w[3]} for k, w in each],
            "tool_from_camera": self.tool_from_camera.tolist(),
            "deviation_mm": self.deviation_mm,
        }


def walls_of_planes(
    images: Sequence[Sequence[ImagePlane]],
    names: Sequence[str],
    pixels: int,
    world_from_tool: np.ndarray,
    options: WallOptions,
    origin: str,
    targets: np.ndarray | None = None,
) -> FoundWalls:
    """Find the walls that the planes of images from known robot poses show.

    Args:
        images: The planes of each image, as `planes_of_image` finds them.
        names: What each image is called.
        pixels: Pixels of an image.
        world_from_tool: The images' poses, shape (N, 4, 4), metres.
        options: How planes were found, and are matched.
        origin: Where the images come from, for messages.
        targets: The name of the one wall that each image shows, shape (N,); None: walls are looked
            for.

    Raises:
        CalibrationDataError: There is no wall in the images.
    """
    seen = np.array([bool(own) for own in images])
    seeing = int(seen.sum())
    # The rotation of the hand-eye and a wall's normal have five unknowns, and each image gives two:
    # three images determine them, and the fourth is the check.
    fewest = 4
    if seeing < fewest:
        flat = f"flat on {options.least_share:.0%} and to within {options.tolerance_mm:g} mm"
        what = f"show anything {flat}" if targets is None else "have enough readings for a plane"
        said = f"{seeing} of {len(images)} images {what}; {fewest} must"
        raise CalibrationDataError(f"{origin}: {said}.")
    given = labels = None
    if targets is not None:
        # A wall without a single measurement has no place.
        given = np.unique(targets[seen])
        labels = torch.from_numpy(np.searchsorted(given, targets))
    planes = seen_planes(images, torch.from_numpy(np.array(world_from_tool)), pixels, labels)
    joint = match_single_ray(planes) if pixels == 1 else match(planes, options.fewest_images)
    on_wall = joint.wall >= 0
    if not bool(on_wall.any()):
        said = f"no hand-eye transform makes planes of {options.fewest_images} images one wall"
        raise CalibrationDataError(f"{origin}: {said}. Are poses of these images?")
    if given is None:  # The walls in the order of their pixels.
        support = torch.bincount(joint.wall[on_wall], planes.support[on_wall], len(joint.walls))
        joint = joint.reordered(support.argsort(descending=True, stable=True))
    called = _names(joint) if given is None else [str(name) for name in given]
    views = on_wall.nonzero()[:, 0].tolist()
    views.sort(key=lambda k: (int(planes.image[k]), int(joint.wall[k])))
    deviation, far = 1000 * joint.deviation, FoundWalls.OFF_WALL_MM
    off = torch.where(on_wall, deviation.clamp(max=far), far)
    return FoundWalls(
        names=called,
        walls=joint.walls.numpy(),
        image=planes.image[views].numpy(),
        wall=joint.wall[views].numpy(),
        gradient=None if given is not None else planes.gradient[views].numpy(),
        tool_from_camera=joint.tool_from_camera.numpy(),
        error=joint.parameters.coefficients.numpy(),
        deviation_mm=float(deviation[on_wall].square().mean().sqrt()),
        misfit_mm=float(off.square().mean().sqrt()),
        left_out=_left_out(names, planes, joint, options),
    )


def _names(joint: Joint) -> list[str]:
    """Number the walls; the lowest horizontal one is the floor, as z points up.

    Its normal is within 5 degrees of z: robots stand more upright, and ramps are steeper.
    """
    level = joint.walls[:, 2] > math.cos(math.radians(5))
    floor = -1
    if bool(level.any()):
        # A horizontal wall's height is -d.
        floor = int(torch.where(level, joint.walls[:, 3], -torch.inf).argmax())
    others = (f"wall {number}" for number in range(1, len(level) + 1))
    return ["floor" if k == floor else next(others) for k in range(len(level))]


def _left_out(
    names: Sequence[str], planes: SeenPlanes, joint: Joint, options: WallOptions
) -> dict[str, str]:
    """Return why images, and planes of images, are on no wall, in the order of the images."""
    seen, on_wall = (set(planes.image[own].tolist()) for own in (joint.wall > -2, joint.wall >= 0))
    flat = f"nothing flat covers {100 * options.least_share:g} % of it to within "
    flat += f"{options.tolerance_mm:g} mm"
    # Where each image shows one known wall, that wall is what it is off.
    known = planes.label is not None
    flat, nearest = ("fewer than three returns", "its") if known else (flat, "the nearest")
    found = {k: {} for k in range(len(names))}
    for k in found.keys() - on_wall:
        found[k][names[k]] = "none of its planes is on a wall" if k in seen else flat
    for k in (joint.wall < 0).nonzero()[:, 0].tolist():
        off, image = float(joint.deviation[k]), int(planes.image[k])
        far = f"{1000 * off:.0f} mm from {nearest} wall"
        far = far if math.isfinite(off) else "turned away from its wall" if known else "faces none"
        name = names[image] if known else f"{names[image]}, plane {int(planes.number[k]) + 1}"
        found[image][name] = far if known else f"{far}, or not seen in enough images"
    return {name: reason for own in found.values() for name, reason in own.items()}
