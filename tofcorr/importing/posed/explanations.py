"""Whether walls fit far better if poses or images were exchanged, mirrored or shifted.

A hand-eye transform makes the planes of right images and poses coincide to within the camera's
error. Wrong ones leave them decimetres apart; then the usual mistakes are undone one by one, to see
whether one of them explains it.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from tofcorr.errors import CalibrationDataError
from tofcorr.geometry import se3
from tofcorr.importing.posed.chosen import Chosen
from tofcorr.importing.posed.images import RadialImages
from tofcorr.importing.walls.finding import PosedImages, find_walls_in
from tofcorr.importing.walls.found import FoundWalls
from tofcorr.importing.walls.options import WallOptions

SUSPICIOUS_MM = 20.0
"""Misfit from which other explanations are tried, millimetres: twice what an uncalibrated camera
leaves."""

_FAR_BETTER = 0.5
"""Another explanation is named if it leaves at most this share of the misfit."""

_MOST_MM = 60.0
"""What a plane that lies on no wall counts, millimetres: the nearness at which planes are gathered
into walls."""

_LOOKED_AT = 30
"""Images on which explanations are compared: enough for every wall of a room, and quick."""


@dataclass(frozen=True)
class _Explanation:
    """A mistake, undone.

    Attributes:
        sentence: What to say if it explains the images, with places for both misfits.
        fatal: Whether the recording would be useless.
        poses: Undoes it in the poses (N, 4, 4).
        image: Undoes it in one image.
    """

    sentence: str
    fatal: bool
    poses: Callable[[np.ndarray], np.ndarray] = np.asarray
    image: Callable[[Tensor], Tensor] = torch.as_tensor


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
    image=lambda image: image.flip(1),
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
        The sentence; None if the walls are as good as can be expected, or no mistake explains them.

    Raises:
        CalibrationDataError: The mistake leaves nothing useful.
    """
    if given is not None and misfit_mm(given) <= SUSPICIOUS_MM:
        return None
    few = np.unique(np.linspace(0, len(chosen.images) - 1, _LOOKED_AT).round().astype(int))
    before = _MOST_MM if given is None else misfit_mm(given)
    explanations = [_INVERSE, _MIRRORED]
    if chosen.paired_by != "time":
        explanations += _SHIFTED
    tried = [
        (_misfit_under(explanation, images, chosen, few, options), explanation)
        for explanation in explanations
    ]
    least, best = min(tried, key=lambda one: one[0])
    if least > _FAR_BETTER * before:
        return None
    sentence = best.sentence.format(given=before, other=least)
    if best.fatal:
        raise CalibrationDataError(f"{images.source.origin}: {sentence}")
    return sentence


def _misfit_under(
    explanation: _Explanation,
    images: RadialImages,
    chosen: Chosen,
    few: np.ndarray,
    options: WallOptions,
) -> float:
    poses = explanation.poses(chosen.world_from_tool)

    def undone() -> Iterator[tuple[Tensor, Tensor]]:
        for k in few:
            distance, valid = images.radial(int(chosen.images[k]))
            yield explanation.image(distance), explanation.image(valid)

    posed = PosedImages(
        origin=images.source.origin,
        camera=images.source.camera,
        world_from_tool=poses[few],
        images=undone(),
    )
    try:
        return misfit_mm(find_walls_in(posed, np.eye(4), options))
    except CalibrationDataError:
        return _MOST_MM
