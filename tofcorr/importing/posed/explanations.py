"""What mistake explains that the planes of the images do not coincide.

A hand-eye transform makes the planes of right images and poses coincide to within the camera's
error. Wrong ones leave them decimetres apart; then the usual mistakes are undone one by one, to see
whether one of them explains it.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeVar

import numpy as np

from tofcorr.errors import CalibrationDataError
from tofcorr.importing.posed.chosen import Chosen
from tofcorr.importing.posed.images import RadialImages
from tofcorr.importing.posed.misfit import MOST_MM, SUSPICIOUS_MM, misfit_mm
from tofcorr.importing.posed.mistakes import NO_MISTAKE, Mistake, possible_mistakes
from tofcorr.importing.posed.shifted_part import shifted_part
from tofcorr.importing.walls.finding import PosedImages, walls_of_planes
from tofcorr.importing.walls.found import FoundWalls
from tofcorr.importing.walls.options import WallOptions

Tried = TypeVar("Tried")

_FAR_BETTER = 0.5
"""A mistake is named if undoing it leaves at most this share of the misfit. Set by hand: a mistake
undone leaves a third and less in simulated rooms, a second mistake nearly all."""

_LOOKED_AT = 30
"""Images on which mistakes are undone: enough for every wall of a room, and quick."""


@dataclass(frozen=True, kw_only=True)
class Suspect:
    """Images and poses that do not fit.

    Attributes:
        images: All images.
        chosen: Those used, with poses.
        options: How walls are found.
        lists: Whether images and poses are paired one to one.
        far_lags: Finds lags of seconds that may explain it (`tofcorr.importing.timing.far_lag`).
        at_lag: Chooses images and poses anew at a lag, seconds.
    """

    images: RadialImages
    chosen: Chosen
    options: WallOptions
    lists: bool
    far_lags: Callable[[], list[float]]
    at_lag: Callable[[float], Chosen]


def explain_misfit(suspect: Suspect, given: FoundWalls | None) -> str | None:
    """Name the mistake that explains why planes do not coincide.

    Args:
        suspect: Images and poses.
        given: The walls of images and poses as given; None: none were found.

    Returns:
        A sentence that says that no mistake explains it; None if the walls are as good as can be
        expected, or there are none.

    Raises:
        CalibrationDataError: A mistake explains it; the message names it, and both misfits.
    """
    before = misfit_mm(given)
    if before <= SUSPICIOUS_MM:
        return None
    images, chosen = suspect.images, suspect.chosen
    origin = images.source.origin
    if suspect.lists and given is not None:
        part = shifted_part(images, chosen, given, images.source.names)
        if part is not None:
            raise CalibrationDataError(f"{origin}: {part}")
    amplitude = images.read(int(chosen.images[0])).amplitude is not None
    mistakes = possible_mistakes(amplitude=amplitude, lists=suspect.lists)
    least, best = _best_of(mistakes, lambda one: _misfit_without(one, suspect, chosen))
    if least > _FAR_BETTER * before:
        lags = [0.0, *suspect.far_lags()]
        left, late = _best_of(lags, lambda one: _misfit_at(one, suspect) if one else before)
        if left <= _FAR_BETTER * before:
            when = "late" if late > 0 else "early"
            raise CalibrationDataError(
                f"{origin}: Walls are off by {before:.0f} mm with the time stamps as given and by "
                f"{left:.0f} mm with images {abs(late):.1f} s {when}: add --time-offset-s "
                f"{-late:.1f}."
            )
        return None if given is None else _unexplained(given, len(chosen.images))
    raise CalibrationDataError(
        f"{origin}: Walls are off by {before:.0f} mm with images and poses as given and by "
        f"{least:.0f} mm with {best.undone}: {best.advice}"
    )


def _unexplained(given: FoundWalls, count: int) -> str:
    seen = len({view.image for view in given.views})
    return (
        f"{seen} of {count} images show a wall, and planes are off by {misfit_mm(given):.0f} mm "
        f"(one on no wall counts {MOST_MM:.0f}); up to {SUSPICIOUS_MM:.0f} are expected. Do "
        "images and poses belong together, and are there large walls in view?"
    )


def _best_of(tried: list[Tried], misfit: Callable[[Tried], float]) -> tuple[float, Tried]:
    """Return the least misfit and what gives it; the first that leaves little ends the search."""
    found: list[tuple[float, Tried]] = []
    for one in tried:
        found.append((misfit(one), one))
        if found[-1][0] <= _FAR_BETTER * SUSPICIOUS_MM:
            break
    return min(found, key=lambda pair: pair[0])


def _misfit_at(late: float, suspect: Suspect) -> float:
    """Return the misfit of some of the images paired with other poses, millimetres."""
    try:
        chosen = suspect.at_lag(late)
    except CalibrationDataError:
        return MOST_MM
    return _misfit_without(NO_MISTAKE, suspect, chosen)


def _misfit_without(mistake: Mistake, suspect: Suspect, chosen: Chosen) -> float:
    """Return the misfit of some of the images with a mistake undone, millimetres."""
    images = suspect.images
    few = np.unique(np.linspace(0, len(chosen.images) - 1, _LOOKED_AT).round().astype(int))
    posed = PosedImages(
        origin=images.source.origin,
        camera=images.source.camera,
        world_from_tool=mistake.poses(chosen.world_from_tool)[few],
    )
    numbers = chosen.images[few].tolist()
    if mistake.image is None:
        planes = [images.planes(k) for k in numbers]
    else:
        planes = [images.planes_in(*mistake.image(images, k)) for k in numbers]
    try:
        return misfit_mm(walls_of_planes(posed, planes, np.eye(4), suspect.options))
    except CalibrationDataError:
        return MOST_MM
