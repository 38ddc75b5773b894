"""Whether walls fit far better if poses or images were exchanged, mirrored or shifted.

A hand-eye transform makes the planes of right images and poses coincide to within the camera's
error. Wrong ones leave them decimetres apart; then the usual mistakes are undone one by one, to see
whether one of them explains it.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from tofcorr.errors import CalibrationDataError
from tofcorr.geometry import se3
from tofcorr.importing.posed.chosen import Chosen
from tofcorr.importing.posed.images import RadialImages
from tofcorr.importing.source import DepthImage
from tofcorr.importing.walls.finding import PosedImages, walls_of_planes
from tofcorr.importing.walls.found import FoundWalls
from tofcorr.importing.walls.options import WallOptions

SUSPICIOUS_MM = 20.0
"""Misfit from which other explanations are tried, millimetres: twice what an uncalibrated camera
leaves."""

_FAR_BETTER = 0.5
"""Another explanation is named if it leaves at most this share of the misfit. Set by hand: a
mistake undone leaves a third and less in simulated rooms, a second mistake nearly all."""

_MOST_MM = 60.0
"""What a plane that lies on no wall counts, millimetres: the nearness at which planes are gathered
into walls."""

_LEAST_MILLIMETRES = 50.0
"""A typical number of a depth image from here on is in millimetres, below in metres: cameras
on robots see from 0.05 to 50 m."""

_LOOKED_AT = 30
"""Images on which explanations are compared: enough for every wall of a room, and quick."""


@dataclass(frozen=True)
class _Explanation:
    """A mistake, undone.

    Attributes:
        sentence: What to say if it explains the images, with places for both misfits.
        fatal: Whether the recording would be useless.
        poses: Undoes it in the poses (N, 4, 4).
        image: Reads one image with it undone: distances along the ray, and where they are valid;
            None: images are as they should be.
    """

    sentence: str
    fatal: bool
    poses: Callable[[np.ndarray], np.ndarray] = np.asarray
    image: Callable[[RadialImages, int], tuple[Tensor, Tensor]] | None = None


def _mirrored(images: RadialImages, number: int) -> tuple[Tensor, Tensor]:
    distance, valid = images.radial(number)
    return distance.flip(1), valid.flip(1)


def _exchanged(images: RadialImages, number: int) -> tuple[Tensor, Tensor]:
    image = images.read(number)
    assert image.amplitude is not None
    counts = np.where(image.amplitude > 0, image.amplitude, np.nan)
    unit = 1e-3 if np.nanmedian(counts) > _LEAST_MILLIMETRES else 1.0
    return images.along_rays(DepthImage((unit * counts).astype(np.float32)))


_INVERSE = _Explanation(
    "Walls are off by {given:.0f} mm with the poses as given and by {other:.0f} mm with their "
    "inverses: are the poses tool_from_base, or is --eye-to-hand missing or too much?",
    fatal=True,
    poses=lambda poses: se3.inverse(torch.from_numpy(np.array(poses))).numpy(),
)
_MIRRORED = _Explanation(
    "Walls are off by {given:.0f} mm with the images as given and by {other:.0f} mm with the "
    "columns mirrored: does the camera's driver flip its images?",
    fatal=False,
    image=_mirrored,
)
_EXCHANGED = _Explanation(
    "Walls are off by {given:.0f} mm with the images as given and by {other:.0f} mm with depth and "
    "amplitude exchanged: swap --depth and --amplitude.",
    fatal=True,
    image=_exchanged,
)
_SHIFTED = tuple(
    _Explanation(
        f"Walls are off by {{given:.0f}} mm with images and poses paired by their order and by "
        f"{{other:.0f}} mm with the poses shifted by {shift:+d}: was an image or a pose dropped?",
        fatal=True,
        poses=lambda poses, shift=shift: np.roll(poses, shift, axis=0),
    )
    for shift in (1, -1)
)


def misfit_mm(found: FoundWalls) -> float:
    """Return how far planes are from their walls, root mean square, millimetres.

    A plane on no wall counts 60 mm.
    """
    on_wall = len(found.views)
    off = sum("plane" in one.view for one in found.left_out)
    square = on_wall * min(found.deviation_mm, _MOST_MM) ** 2 + off * _MOST_MM**2
    return float(np.sqrt(square / max(on_wall + off, 1)))


def explain_misfit(
    images: RadialImages, chosen: Chosen, options: WallOptions, given: FoundWalls | None
) -> str | None:
    """Return a sentence about the mistake that explains why planes do not coincide.

    Args:
        images: All images.
        chosen: Those used, with poses.
        options: How walls are found.
        given: The walls of images and poses as given; None: none were found.

    Returns:
        The sentence, which also says so if no mistake explains it; None if the walls are as good as
        can be expected, or there are none and no mistake explains that.

    Raises:
        CalibrationDataError: The mistake leaves nothing useful.
    """
    if given is not None and misfit_mm(given) <= SUSPICIOUS_MM:
        return None
    few = np.unique(np.linspace(0, len(chosen.images) - 1, _LOOKED_AT).round().astype(int))
    before = _MOST_MM if given is None else misfit_mm(given)
    explanations = [_INVERSE, _MIRRORED]
    if images.read(int(chosen.images[0])).amplitude is not None:
        explanations.append(_EXCHANGED)
    if chosen.paired_by != "time":
        explanations += _SHIFTED
    tried = [
        (_misfit_under(explanation, images, chosen, few, options), explanation)
        for explanation in explanations
    ]
    least, best = min(tried, key=lambda one: one[0])
    if least > _FAR_BETTER * before:
        return None if given is None else _unexplained(given, len(chosen.images))
    sentence = best.sentence.format(given=before, other=least)
    if best.fatal:
        raise CalibrationDataError(f"{images.source.origin}: {sentence}")
    return sentence


def _unexplained(given: FoundWalls, count: int) -> str:
    seen = len({view.image for view in given.views})
    return (
        f"{seen} of {count} images show a wall, and planes are off by {misfit_mm(given):.0f} mm "
        f"(one on no wall counts {_MOST_MM:.0f}); up to {SUSPICIOUS_MM:.0f} are expected. Do "
        "images and poses belong together, and are there large walls in view?"
    )


def _misfit_under(
    explanation: _Explanation,
    images: RadialImages,
    chosen: Chosen,
    few: np.ndarray,
    options: WallOptions,
) -> float:
    posed = PosedImages(
        origin=images.source.origin,
        camera=images.source.camera,
        world_from_tool=explanation.poses(chosen.world_from_tool)[few],
    )
    numbers = chosen.images[few].tolist()
    if explanation.image is None:
        planes = [images.planes(k) for k in numbers]
    else:
        planes = [images.planes_in(*explanation.image(images, k)) for k in numbers]
    try:
        return misfit_mm(walls_of_planes(posed, planes, np.eye(4), options))
    except CalibrationDataError:
        return _MOST_MM
