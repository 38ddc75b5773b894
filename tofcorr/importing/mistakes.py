"""What mistake explains that images and poses do not fit: impossible units, and the usual mistakes.

A hand-eye transform makes the planes of right images and poses coincide to within the camera's
error. Wrong ones leave them decimetres apart; then the usual mistakes are undone one by one, to see
whether one of them explains it.
"""

from collections.abc import Callable, Mapping
from functools import partial

import numpy as np
import torch

from tofcorr.errors import CalibrationDataError
from tofcorr.importing.images import DepthImage
from tofcorr.importing.robot_images import Chosen, ImagesOfPlanes
from tofcorr.importing.walls.finding import FoundWalls, walls_of_planes
from tofcorr.importing.walls.hand_eye import distances, exact
from tofcorr.importing.walls.image_planes import ImagePlane, WallOptions, seen_planes
from tofcorr.plausibility.mistakes import FAR_BETTER, IN_IMAGES, IN_POSES

_NEAREST, _FARTHEST = 0.03, 50.0
"""Metres: nearer even single-pixel sensors give no distance, but depth in kilometres, or a unit
given twice, does; farther no time-of-flight camera on a robot sees, nor does an arm reach: 0.05 m
read as millimetres is 50."""

_SUSPICIOUS_MM = 20.0
"""Misfit from which a mistake is suspected, millimetres: twice what an uncalibrated camera
leaves."""


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
    if typical > _FARTHEST:
        raise CalibrationDataError(
            f"{origin}: the median depth is {typical:.4g} m. Is it in millimetres? Add "
            "--depth-unit-mm 1."
        )
    if typical < _NEAREST:
        raise CalibrationDataError(
            f"{origin}: the median depth is {1000 * typical:.3g} mm. Is it in metres? Add "
            "--depth-unit-mm 1000."
        )


def refuse_impossible_poses(world_from_tool: np.ndarray, origin: str, least: float = 1e-3) -> None:
    """Refuse poses that do not move, or that are not in metres.

    Args:
        world_from_tool: The poses, shape (N, 4, 4).
        origin: For the message.
        least: Metres, or radians, that some poses must differ by: less reveals no hand-eye
            transform.

    Raises:
        CalibrationDataError: As said.
    """
    extent = float(np.linalg.norm(np.ptp(world_from_tool[:, :3, 3], axis=0)))
    turned = float(np.abs(world_from_tool[:, :3, :3] - world_from_tool[0, :3, :3]).max())
    if extent > _FARTHEST:
        raise CalibrationDataError(
            f"{origin}: the tool moves over {extent:.4g} m. Are the translations in millimetres? "
            "Expected metres (in CSV, columns tx_mm, ty_mm, tz_mm are scaled)."
        )
    if max(extent, turned) < least:
        raise CalibrationDataError(
            f"{origin}: all poses are the same to {1000 * extent:.2g} mm; expected a robot that "
            "moves and turns the camera."
        )


_OF_POSES = {
    "inverted": "their inverses: are the poses those of the base in the tool (--base-frame and "
    "--tool-frame exchanged), or is --eye-to-hand missing or too much?",
    "quaternions": "quaternions read as w x y z: write them as x y z w, or in a CSV whose header "
    "names qw, qx, qy, qz.",
    "rotations": "rotations inverted and translations as they are: are the matrices written column "
    "by column, or the quaternions those of the inverse?",
}
"""What undoes usual mistakes in poses, and advice."""


def _amplitudes(image: DepthImage) -> np.ndarray:
    """Return the amplitudes of an image as if they were its depth, metres."""
    assert image.amplitude is not None
    counts = np.where(image.amplitude > 0, image.amplitude, np.nan)
    return counts / (1000 if np.nanmedian(counts) > _FARTHEST else 1)


def _shifts() -> list[int]:
    """Return by how many poses a list may be shifted, the likely ones first.

    Each costs a search for walls, and more than three images are rarely dropped in a row.
    """
    return [shift for most in (1, 2, 3) for shift in (most, -most)]


def _mistakes(*, lists: bool, amplitudes: bool) -> dict[str, dict[str, Callable[..., np.ndarray]]]:
    """Return what undoes each mistake, in `poses` or in the `depth` of an image, by its advice."""
    found: dict[str, dict[str, Callable[..., np.ndarray]]] = {
        said: {"poses": IN_POSES[name].undo} for name, said in _OF_POSES.items()
    }
    for shift in _shifts() if lists else ():
        said = f"the poses shifted by {shift:+d}: was an image or a pose dropped?"
        found[said] = {"poses": partial(np.roll, shift=shift, axis=0)}
    said = "the columns mirrored: does the camera's driver flip its images? Turn that off, or flip "
    found[said + "them back."] = {"depth": lambda image: IN_IMAGES["mirrored"].undo(image.depth)}
    for factor in (1 / 10, 10):
        said = f"all distances multiplied by {factor:g}: is --depth-unit-mm right?"
        found[said] = {"depth": lambda image, factor=factor: factor * image.depth}
    if amplitudes:
        said = "depth and amplitude exchanged: swap --depth and --amplitude."
        found[said] = {"depth": _amplitudes}
    return found


def _misfit(
    images: ImagesOfPlanes,
    options: WallOptions,
    used: Chosen,
    poses: Callable[[np.ndarray], np.ndarray] = np.asarray,
    depth: Callable[[DepthImage], np.ndarray] | None = None,
) -> float:
    """Return the misfit of 30 images with a mistake undone: enough for every wall of a room."""
    few = np.unique(np.linspace(0, len(used.images) - 1, 30).round().astype(int))

    def planes(k: int) -> list[ImagePlane]:
        if depth is None:
            return images.planes(k)
        undone = depth(images.read(k)).astype(np.float32)
        return images.planes_in(DepthImage(np.ascontiguousarray(undone)))

    try:
        return walls_of_planes(
            [planes(k) for k in used.images[few].tolist()],
            [images.source.names[int(k)] for k in used.images[few]],
            images.rays[..., 0].numel(),
            poses(used.world_from_tool)[few],
            options,
            images.source.origin,
        ).misfit_mm
    except CalibrationDataError:
        return FoundWalls.OFF_WALL_MM


def explain_misfit(
    images: ImagesOfPlanes,
    chosen: Chosen,
    given: FoundWalls | None,
    options: WallOptions,
    *,
    lists: bool,
    far_lags: Callable[[], list[float]],
    at_lag: Callable[[float], Chosen],
) -> list[str]:
    """Name the mistake that explains why planes do not coincide.

    Args:
        images: All images.
        chosen: Those used, with poses.
        given: The walls of images and poses as given; None: none were found.
        options: How walls are found.
        lists: Whether images and poses are paired one to one.
        far_lags: Proposes lags of seconds that may explain it (`tofcorr.importing.timing`).
        at_lag: Chooses images and poses at another lag, seconds.

    Returns:
        A sentence that says that no mistake explains it; none if the walls are as good as can be
        expected, or there are none.

    Raises:
        CalibrationDataError: A mistake explains it; the message names it, and both misfits.
    """
    farthest, origin = FoundWalls.OFF_WALL_MM, images.source.origin
    before = farthest if given is None else given.misfit_mm
    if before <= _SUSPICIOUS_MM:
        return []
    if lists and given is not None:
        _refuse_shifted_part(images, chosen, given)

    def refuse_best(given_as: str, trials: Mapping[str, Callable[[], float]]) -> None:
        """Refuse the mistake that leaves least, if that is little; what leaves none ends it."""
        left = {}
        for said, trial in trials.items():
            left[said] = trial()
            if left[said] <= FAR_BETTER * _SUSPICIOUS_MM:
                break
        best = min(left, key=left.__getitem__, default="")
        if left.get(best, np.inf) <= FAR_BETTER * before:
            raise CalibrationDataError(
                f"{origin}: Walls are off by {before:.0f} mm with {given_as} as given and by "
                f"{left[best]:.0f} mm with {best}"
            )

    def late_by(late: float) -> float:
        """Return the misfit of the images paired with other poses."""
        try:
            return _misfit(images, options, at_lag(late))
        except CalibrationDataError:
            return farthest

    amplitudes = images.read(int(chosen.images[0])).amplitude is not None
    mistakes = _mistakes(lists=lists, amplitudes=amplitudes)
    tried = partial(_misfit, images, options, chosen)
    refuse_best("images and poses", {said: partial(tried, **mistakes[said]) for said in mistakes})
    said = "images {:.1f} s {}: add --time-offset-s {:.1f}."
    trials = {
        said.format(abs(late), "late" if late > 0 else "early", -late): partial(late_by, late)
        for late in far_lags()
    }
    refuse_best("the time stamps", trials)
    if given is None:
        return []
    return [
        f"{len(np.unique(given.image))} of {len(chosen.images)} images show a wall, and planes are "
        f"off by {before:.0f} mm (one on no wall counts {farthest:.0f}); up to "
        f"{_SUSPICIOUS_MM:.0f} are expected. Do images and poses belong together, and are there "
        "large walls in view?"
    ]


def _refuse_shifted_part(
    images: ImagesOfPlanes, chosen: Chosen, found: FoundWalls, near: float = 0.03
) -> None:
    """Refuse a part of the images whose poses are shifted.

    Where one image or pose was dropped in the middle of a list, the first part is paired rightly
    and shows the walls; the rest lies on them with the poses shifted.

    Args:
        images: All images.
        chosen: Those used, with poses.
        found: The walls, and the hand-eye transform that goes with them.
        near: Metres within which a plane lies on a wall: three times a typical error, and far below
            the way from stop to stop.

    Raises:
        CalibrationDataError: There is such a part.
    """
    planes = [images.planes(k) for k in chosen.images.tolist()]
    hand_eye, walls = exact(torch.from_numpy(found.tool_from_camera)), torch.from_numpy(found.walls)

    def on_walls(poses: np.ndarray) -> np.ndarray:
        """Return which images have most of their planes on a wall, shape (N,)."""
        seen = seen_planes(planes, torch.from_numpy(np.array(poses)), 1)
        close = distances(*seen.in_world(hand_eye), walls).min(dim=1).values < near
        return np.bincount(seen.image.numpy(), 2.0 * close.numpy() - 1, len(planes)) > 0

    poses = chosen.world_from_tool
    seeing = np.array([bool(own) for own in planes])
    off = seeing & ~on_walls(poses)
    for shift in _shifts():
        fits = off & on_walls(np.roll(poses, shift, axis=0))
        # Fewer fit by chance; some show only walls that the rightly paired part did not.
        if fits.sum() >= max(4, off.sum() / 2):
            first, last = (images.source.names[k] for k in chosen.images[fits][[0, -1]])
            raise CalibrationDataError(
                f"{images.source.origin}: {fits.sum()} of {seeing.sum()} images, '{first}' to "
                f"'{last}', lie on the walls with the poses shifted by {shift:+d} and not with "
                f"their own: was an image or a pose dropped before '{first}'?"
            )
