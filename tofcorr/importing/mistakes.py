"""What mistake explains that images and poses do not fit: impossible units, and the usual mistakes.

A hand-eye transform makes the planes of right images and poses coincide to within the camera's
error. Wrong ones leave them decimetres apart; then the usual mistakes are undone one by one, to see
whether one of them explains it.
"""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from tofcorr.errors import CalibrationDataError
from tofcorr.geometry import se3
from tofcorr.importing.images import DepthImage
from tofcorr.importing.robot_images import Chosen, ImagesOfPlanes
from tofcorr.importing.walls.finding import FoundWalls, walls_of_planes
from tofcorr.importing.walls.gathering import distances, seen_planes
from tofcorr.importing.walls.image_planes import WallOptions
from tofcorr.plausibility.mistakes import reordered, transposed

_POSSIBLE_DEPTH = 0.03, 50.0
"""Metres: below it even single-pixel sensors give no distance, but depth in kilometres, or a unit
given twice, does; beyond it no time-of-flight camera on a robot sees: 0.05 m read as millimetres
is 50."""

_POSSIBLE_MOVE = 1e-3, 50.0
"""Metres (or radians) that some pose must differ by, for below it no hand-eye transform is
revealed; and metres between two poses of one recording: beyond any arm, and most rooms."""

_SUSPICIOUS_MM = 20.0
"""Misfit from which a mistake is suspected, millimetres: twice what an uncalibrated camera
leaves."""

_MOST_MM = 60.0
"""What a plane that lies on no wall counts, millimetres: the nearness at which planes are gathered
into walls."""

_SHIFTS = (1, -1, 2, -2, 3, -3)
"""Poses by which a list may be shifted, the likely ones first. Set by hand: each shift costs a
search for walls, and more than three images are rarely dropped in a row."""


def refuse_impossible_depth(median_depth: np.ndarray, origin: str) -> None:
    """Refuse depth that is not in metres.

    Args:
        median_depth: Median of each image, shape (I,), as metres; NaN without returns.
        origin: For the message.

    Raises:
        CalibrationDataError: No image has a return, or the typical depth is impossible.
    """
    if not np.isfinite(median_depth).any():
        raise CalibrationDataError(f"{origin}: no image has a pixel with a return.")
    typical = float(np.nanmedian(median_depth))
    if typical > _POSSIBLE_DEPTH[1]:
        raise CalibrationDataError(
            f"{origin}: the median depth is {typical:.4g} m. Is it in millimetres? Add "
            "--depth-unit-mm 1."
        )
    if typical < _POSSIBLE_DEPTH[0]:
        raise CalibrationDataError(
            f"{origin}: the median depth is {1e3 * typical:.3g} mm. Is it in metres? Add "
            "--depth-unit-mm 1000."
        )


def refuse_impossible_poses(world_from_tool: np.ndarray, origin: str) -> None:
    """Refuse poses that do not move, or that are not in metres.

    Raises:
        CalibrationDataError: As said.
    """
    extent = float(np.linalg.norm(np.ptp(world_from_tool[:, :3, 3], axis=0)))
    turned = float(np.abs(world_from_tool[:, :3, :3] - world_from_tool[0, :3, :3]).max())
    if extent > _POSSIBLE_MOVE[1]:
        raise CalibrationDataError(
            f"{origin}: the tool moves over {extent:.4g} m. Are the translations in millimetres? "
            "Expected metres (in CSV, columns tx_mm, ty_mm, tz_mm are scaled)."
        )
    if max(extent, turned) < _POSSIBLE_MOVE[0]:
        raise CalibrationDataError(
            f"{origin}: all poses are the same to {1e3 * extent:.2g} mm; expected a robot that "
            "moves and turns the camera."
        )


class Mistake(NamedTuple):
    """A mistake, undone.

    Attributes:
        undone: What was done to undo it; follows 'by ... mm with'.
        advice: A question or advice to end the sentence.
        poses: Undoes it in the poses (N, 4, 4).
        image: Undoes it in an image: distances along the ray, and where they are valid; None:
            images are as they should be.
    """

    undone: str
    advice: str
    poses: Callable[[np.ndarray], np.ndarray] = np.asarray
    image: Callable[[ImagesOfPlanes, DepthImage], tuple[Tensor, Tensor]] | None = None


def _mirrored(images: ImagesOfPlanes, image: DepthImage) -> tuple[Tensor, Tensor]:
    distance, valid = images.along_rays(image)
    return distance.flip(1), valid.flip(1)


def _exchanged(images: ImagesOfPlanes, image: DepthImage) -> tuple[Tensor, Tensor]:
    assert image.amplitude is not None
    counts = np.where(image.amplitude > 0, image.amplitude, np.nan)
    # Cameras on robots see from 0.05 to 50 m: larger numbers are millimetres.
    unit = 1e-3 if np.nanmedian(counts) > _POSSIBLE_DEPTH[1] else 1.0
    return images.along_rays(DepthImage((unit * counts).astype(np.float32)))


def _scaled(factor: float) -> Mistake:
    def image(images: ImagesOfPlanes, image: DepthImage) -> tuple[Tensor, Tensor]:
        distance, valid = images.along_rays(image)
        return factor * distance, valid

    undone = f"all distances multiplied by {factor:g}"
    return Mistake(undone, "is --depth-unit-mm right?", image=image)


def _shifted(shift: int) -> Mistake:
    return Mistake(
        f"the poses shifted by {shift:+d}",
        "was an image or a pose dropped?",
        lambda poses: np.roll(poses, shift, axis=0),
    )


_OF_POSES = (
    Mistake(
        "their inverses",
        "are the poses those of the base in the tool (--base-frame and --tool-frame exchanged), or "
        "is --eye-to-hand missing or too much?",
        lambda poses: se3.inverse(torch.from_numpy(np.array(poses))).numpy(),
    ),
    Mistake(
        "quaternions read as w x y z",
        "write them as x y z w, or in a CSV whose header names qw, qx, qy, qz.",
        reordered,
    ),
    Mistake(
        "rotations inverted and translations as they are",
        "are the matrices written column by column, or the quaternions those of the inverse?",
        transposed,
    ),
    Mistake(
        "the columns mirrored",
        "does the camera's driver flip its images? Turn that off, or flip them back.",
        image=_mirrored,
    ),
)
_OF_PAIRS = tuple(_shifted(shift) for shift in _SHIFTS)
_OF_UNITS = (_scaled(1 / 10), _scaled(10))
_OF_AMPLITUDES = (
    Mistake("depth and amplitude exchanged", "swap --depth and --amplitude.", image=_exchanged),
)


def misfit_mm(found: FoundWalls | None) -> float:
    """Return how far planes are from their walls, root mean square, millimetres.

    A plane on no wall counts 60 mm; so does every plane where no wall was found (None).
    """
    if found is None:
        return _MOST_MM
    on_wall = len(found.views)
    off = sum("plane" in one.view for one in found.left_out)
    square = on_wall * min(found.deviation_mm, _MOST_MM) ** 2 + off * _MOST_MM**2
    return float(np.sqrt(square / max(on_wall + off, 1)))


def explain_misfit(
    images: ImagesOfPlanes,
    chosen: Chosen,
    given: FoundWalls | None,
    options: WallOptions,
    *,
    lists: bool,
    far_lags: Callable[[], list[float]],
    at_lag: Callable[[float], Chosen],
    far_better: float = 0.5,
) -> str | None:
    """Name the mistake that explains why planes do not coincide.

    Args:
        images: All images.
        chosen: Those used, with poses.
        given: The walls of images and poses as given; None: none were found.
        options: How walls are found.
        lists: Whether images and poses are paired one to one.
        far_lags: Proposes lags of seconds that may explain it (`tofcorr.importing.timing`).
        at_lag: Chooses images and poses at another lag, seconds.
        far_better: A mistake is named if undoing it leaves at most this share of the misfit. Set by
            hand: a mistake undone leaves a third and less in simulated rooms, a second mistake
            nearly all.

    Returns:
        A sentence that says that no mistake explains it; None if the walls are as good as can be
        expected, or there are none.

    Raises:
        CalibrationDataError: A mistake explains it; the message names it, and both misfits.
    """
    before, origin = misfit_mm(given), images.source.origin
    if before <= _SUSPICIOUS_MM:
        return None
    part = _shifted_part(images, chosen, given) if lists and given is not None else None
    if part is not None:
        raise CalibrationDataError(f"{origin}: {part}")
    enough = far_better * _SUSPICIOUS_MM
    amplitudes = images.read(int(chosen.images[0])).amplitude is not None
    mistakes = (
        *(*_OF_POSES, *(_OF_PAIRS if lists else ()), *_OF_UNITS),
        *(_OF_AMPLITUDES if amplitudes else ()),
    )
    least, best = _best_of(
        mistakes, lambda one: _misfit_without(one, images, chosen, options), enough
    )
    if least <= far_better * before:
        raise CalibrationDataError(
            f"{origin}: Walls are off by {before:.0f} mm with images and poses as given and by "
            f"{least:.0f} mm with {best.undone}: {best.advice}"
        )

    def late_by(late: float) -> float:
        """Return the misfit of the images paired with other poses."""
        try:
            return _misfit_without(Mistake("", ""), images, at_lag(late), options)
        except CalibrationDataError:
            return _MOST_MM

    left, late = _best_of(far_lags(), late_by, enough)
    if left <= far_better * before:
        raise CalibrationDataError(
            f"{origin}: Walls are off by {before:.0f} mm with the time stamps as given and by "
            f"{left:.0f} mm with images {abs(late):.1f} s {'late' if late > 0 else 'early'}: add "
            f"--time-offset-s {-late:.1f}."
        )
    if given is None:
        return None
    seen = len({view.image for view in given.views})
    return (
        f"{seen} of {len(chosen.images)} images show a wall, and planes are off by {before:.0f} mm "
        f"(one on no wall counts {_MOST_MM:.0f}); up to {_SUSPICIOUS_MM:.0f} are expected. Do "
        "images and poses belong together, and are there large walls in view?"
    )


def _best_of(
    tried: Sequence[Any], misfit: Callable[[Any], float], enough: float
) -> tuple[float, Any]:
    """Return the least misfit and its cause; the first that leaves little ends the search."""
    least, best = np.inf, None
    for one in tried:
        left = misfit(one)
        if left < least:
            least, best = left, one
        if left <= enough:
            break
    return least, best


def _misfit_without(
    mistake: Mistake, images: ImagesOfPlanes, chosen: Chosen, options: WallOptions
) -> float:
    """Return the misfit of 30 images with a mistake undone: enough for every wall of a room."""
    few = np.unique(np.linspace(0, len(chosen.images) - 1, 30).round().astype(int))
    planes = [
        images.planes_in(*mistake.image(images, images.read(k)))
        if mistake.image
        else images.planes(k)
        for k in chosen.images[few].tolist()
    ]
    poses = mistake.poses(chosen.world_from_tool)[few]
    pixels, origin = images.rays[..., 0].numel(), images.source.origin
    try:
        return misfit_mm(walls_of_planes(planes, pixels, poses, np.eye(4), options, origin))
    except CalibrationDataError:
        return _MOST_MM


def _shifted_part(
    images: ImagesOfPlanes, chosen: Chosen, found: FoundWalls, near: float = 0.03
) -> str | None:
    """Return a sentence about the part of the images whose poses are shifted; None without one.

    Where one image or pose was dropped in the middle of a list, the first part is paired rightly
    and shows the walls; the rest lies on them with the poses shifted.

    Args:
        images: All images.
        chosen: Those used, with poses.
        found: The walls, and the hand-eye transform that goes with them.
        near: Metres within which a plane lies on a wall: three times a typical error, and far below
            the way from stop to stop.
    """
    planes = [images.planes(k) for k in chosen.images.tolist()]
    hand_eye = torch.from_numpy(found.tool_from_camera)

    def on_walls(poses: np.ndarray) -> np.ndarray:
        """Return which images have most of their planes on a wall, shape (N,)."""
        seen = seen_planes(planes, torch.from_numpy(np.array(poses)), 1)
        close = (distances(seen, hand_eye, found.planes()).min(dim=1).values < near).double()
        votes = torch.zeros(len(planes), dtype=torch.float64)
        return (votes.index_add_(0, seen.image, 2 * close - 1) > 0).numpy()

    poses = chosen.world_from_tool
    seeing = np.array([bool(own) for own in planes])
    off = seeing & ~on_walls(poses)
    for shift in _SHIFTS:
        fits = off & on_walls(np.roll(poses, shift, axis=0))
        # Fewer fit by chance; some show only walls that the rightly paired part did not.
        if fits.sum() >= max(4, off.sum() / 2):
            first, last = (images.source.names[k] for k in chosen.images[fits][[0, -1]])
            return (
                f"{fits.sum()} of {seeing.sum()} images, '{first}' to '{last}', lie on the walls "
                f"with the poses shifted by {shift:+d} and not with their own: was an image or a "
                f"pose dropped before '{first}'?"
            )
    return None
