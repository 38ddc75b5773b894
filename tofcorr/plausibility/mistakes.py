"""The usual mistakes in poses, planes and images: one list of (cause, advice, undo), and one judge.

Does one of them, undone, explain why points miss their planes? `importing` undoes some of them
before a recording is written, and words its advice by its own options.
"""

from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from tofcorr.plausibility.alignment import Alignment, Scene, align_with_free_walls
from tofcorr.plausibility.look import Look

FAR_BETTER = 0.5
"""A mistake is named if undoing it leaves at most this share of the misfit. Chosen: a mistake
undone leaves a third and less, a second mistake nearly all."""
SHIFTS = (1, -1, 2, -2)
"""Rows by which poses and images may be shifted against each other. Chosen."""
# Units that translations, offsets and depth come in, as factors to metres.
_UNITS = {"millimetres": 1e-3, "centimetres": 1e-2, "inches": 0.0254}


class Explanation(NamedTuple):
    """A mistake, undone.

    Attributes:
        cause: What the mistake is, to follow "the likely cause: ".
        advice: What to do.
        found: The alignment once it is undone.
        fatal: Whether a fit would be meaningless if it is the cause.
        frees: Whether undoing it frees unknowns, so that some of the misfit falls in any case.
    """

    cause: str
    advice: str
    found: Alignment
    fatal: bool = True
    frees: bool = False


Undo = Callable[[], Scene | Alignment | None]
_Mistake = tuple[str, str, Undo]


def best_explanations(
    look: Look,
    acceptable: float = 0.02,
    times_flat: float = 4.0,
    gain: float = 0.008,
    as_good: float = 1.3,
) -> list[Explanation]:
    """Return the explanations that are about as good as the best and far better than none.

    Args:
        look: The recording.
        acceptable: What an explanation may leave, metres,
        times_flat: or so many times the flatness of the walls.
        gain: What it takes off at the least, metres.
        as_good: Of several, the first listed that comes this near the best is named.
    """
    given = look.given
    most = min(FAR_BETTER * given.badness, max(acceptable, times_flat * look.flatness))
    better = [
        one
        for one in explanations(look)
        if one.found.badness <= most
        and given.badness - one.found.badness > gain
        and (not one.frees or one.found.misfit <= FAR_BETTER * given.misfit)
    ]
    least = min((one.found.badness for one in better), default=0.0)
    return [one for one in better if one.found.badness <= as_good * least]


def explanations(look: Look) -> Iterator[Explanation]:
    """Yield every mistake that can be undone, with the misfit that is left then."""
    for cause, advice, undo in (*_of_poses(look), *_of_planes(look), *_of_images(look)):
        undone = undo()
        found = look.aligned(undone) if isinstance(undone, Scene) else undone
        if found is not None and len(found.rms):
            # Planes that are a few degrees off are no reason to refuse a recording.
            fatal = cause != _WRONG_PLANES
            yield Explanation(cause, advice, found, fatal, frees=not isinstance(undone, Scene))


def reordered(poses: np.ndarray) -> np.ndarray:
    """Return the poses whose quaternions, read as x y z w, were written as w x y z."""
    changed = poses.copy()
    quaternions = Rotation.from_matrix(poses[:, :3, :3]).as_quat()
    changed[:, :3, :3] = Rotation.from_quat(np.roll(quaternions, -1, axis=1)).as_matrix()
    return changed


def transposed(poses: np.ndarray) -> np.ndarray:
    """Return the poses with their rotations inverted, their translations as they are."""
    changed = poses.copy()
    changed[:, :3, :3] = np.swapaxes(poses[:, :3, :3], 1, 2)
    return changed


def mirrored(poses: np.ndarray, axis: int) -> np.ndarray:
    """Return the poses of a world with one axis turned round."""
    sign = np.where(np.arange(4) == axis, -1.0, 1.0)
    return sign[:, None] * poses * sign


def exchanged(poses: np.ndarray, first: int, second: int) -> np.ndarray:
    """Return the poses of a world with two axes exchanged."""
    order = np.arange(4)
    order[[first, second]] = order[[second, first]]
    return poses[:, order][:, :, order]


def scaled(poses: np.ndarray, factor: float) -> np.ndarray:
    """Return the poses with their translations multiplied."""
    changed = poses.copy()
    changed[:, :3, 3] *= factor
    return changed


def _of_poses(look: Look, narrowest: float = 0.02) -> Iterator[_Mistake]:
    """Yield mistakes in poses; a unit is not tried that leaves an extent below `narrowest`, m."""
    scene, poses = look.scene, look.scene.poses
    if not scene.moves:
        return
    shifts = [shift for shift in SHIFTS if len(poses) > 3 + 2 * abs(shift)]
    left, convert = "the poses are of a left-handed world", "convert them to a right-handed frame"
    extent = float(np.ptp(poses[:, :3, 3], axis=0).max())
    changes: list[tuple[str, str, Callable[[np.ndarray], np.ndarray]]] = [
        (
            "the poses are tool_from_world, the inverse of what the format asks for",
            "invert them",
            np.linalg.inv,
        ),
        ("the quaternions are stored as w, x, y, z", "write them as qx, qy, qz, qw", reordered),
        (
            "the rotations are inverted and the translations are not",
            "write world_from_tool",
            transposed,
        ),
        (
            "the poses are in the opposite order of the images",
            "reverse one of them",
            lambda poses: poses[::-1],
        ),
        *(
            (
                f"{left} ({'xyz'[axis]} turned round)",
                f"{convert} before writing",
                lambda poses, axis=axis: mirrored(poses, axis),
            )
            for axis in range(3)
        ),
        *(
            (
                f"{left} ({'xyz'[one]} and {'xyz'[other]} exchanged)",
                f"{convert} before writing",
                lambda poses, one=one, other=other: exchanged(poses, one, other),
            )
            for one, other in ((1, 2), (0, 1), (0, 2))
        ),
        *(
            (
                f"the translations are in {unit}",
                "divide tx, ty, tz",
                lambda poses, factor=factor: scaled(poses, factor),
            )
            for unit, factor in _UNITS.items()
            if factor * extent >= narrowest
        ),
        (
            "the translations are in kilometres",
            "multiply tx, ty, tz",
            lambda poses: scaled(poses, 1000.0),
        ),
    ]
    undone = [
        (cause, advice, lambda change=change: replace(scene, poses=change(poses)))
        for cause, advice, change in changes
    ]
    shifted = [
        (
            f"poses and images are shifted by {abs(shift)} row{'s' if abs(shift) > 1 else ''} "
            "against each other",
            "pair them again: an image or a pose was dropped",
            lambda shift=shift: _shifted(scene, shift),
        )
        for shift in shifts
    ]
    yield from (*undone[:3], *shifted, *undone[3:])


def _shifted(scene: Scene, shift: int) -> Scene:
    """Return the frames that have a pose `shift` rows on, with that pose and their own plane."""
    number = np.arange(len(scene.poses))
    inside = (number + shift >= 0) & (number + shift < len(number))
    return replace(scene.some(inside), poses=scene.poses[number[inside] + shift])


_WRONG_PLANES = "the recorded planes are wrong or of another frame"


def _of_planes(look: Look) -> Iterator[_Mistake]:
    scene = look.scene
    if look.planes != "known":
        return
    yield (
        "the planes' normals nx, ny, nz point the wrong way and d does not",
        "turn nx, ny, nz round",
        lambda: replace(scene, normal=-scene.normal),
    )
    for unit, factor in _UNITS.items():
        yield (
            f"the planes' offsets d are in {unit}",
            "write d in metres",
            lambda factor=factor: replace(scene, offset=factor * scene.offset),
        )
    yield (
        _WRONG_PLANES,
        "measure them again, or train with `planes: unknown`",
        lambda: align_with_free_walls(scene),
    )
    if scene.moves:
        yield (
            "two cameras, or one camera mounted twice, are in one recording",
            "split it where the camera was changed",
            lambda: _in_two_parts(look),
        )
    else:
        yield (
            "the planes are not in the camera's frame, which a recording without robot poses asks "
            "for",
            "write the planes in camera coordinates, or the robot's poses",
            lambda: look.aligned(replace(scene, moves=True)),
        )


def _in_two_parts(look: Look, fewest: int = 6) -> Alignment | None:
    """Return the alignment of the two sides of a cut, each by itself, at the best of some cuts.

    Either side has `fewest` frames at least: seven unknowns, three from a frame.
    """
    scene, count = look.scene, len(look.scene.poses)
    found: list[Alignment] = []
    for share in (1 / 2, 1 / 4, 3 / 4, 1 / 3, 2 / 3):
        cut = round(share * count)
        if min(cut, count - cut) >= fewest:
            before = np.arange(count) < cut
            sides = [look.aligned(scene.some(part)) for part in (before, ~before)]
            known = [side for side in sides if side is not None]
            if len(known) == 2:
                rms = np.concatenate([side.rms for side in known])
                angle = np.concatenate([side.angle for side in known])
                found.append(Alignment(np.eye(4), 0.0, 0.0, rms, angle))
    return min(found, key=lambda one: one.misfit, default=None)


def _of_images(look: Look, nearest: float = 0.1) -> Iterator[_Mistake]:
    """Yield mistakes in images; a unit is not tried that leaves a distance below `nearest`, m."""
    sample = look.sample
    height, width = sample.recording.camera.height, sample.recording.camera.width
    if height * width < 4:
        return
    row, column = np.divmod(sample.pixel, width)
    flips = {
        "mirrored left to right": (row, width - 1 - column),
        "turned upside down": (height - 1 - row, column),
    }
    for words, (r, c) in flips.items():
        yield (
            f"the images are {words}",
            "undo the driver's flip before writing",
            lambda pixel=r * width + c: look.with_images(sample.stored, pixel),
        )
    if height == width:
        yield (
            "the images are transposed: rows are columns",
            "transpose them before writing",
            lambda: look.with_images(sample.stored, column * width + row),
        )
    typical = float(np.nanmedian(sample.stored))
    for unit, factor in {"feet": 0.3048, **_UNITS}.items():
        # A camera that shrinks to a point misses no plane.
        if factor * typical >= nearest:
            yield (
                f"the depth is in {unit}",
                "write metres",
                lambda factor=factor: look.with_images(factor * sample.stored, sample.pixel),
            )
    off, off_pixel = sample.off_mask, sample.off_pixel
    if off is not None and off_pixel is not None and _seen(off):
        yield (
            "the mask is inverted: it is 0 on the target",
            "write 1 where a pixel looks at the target",
            lambda: look.with_images(off, off_pixel),
        )


def _seen(off: np.ndarray, fewest: int = 12) -> bool:
    """Return whether most frames have enough pixels (F, P) off the mask to say it is inverted.

    Any plane fits the few pixels that a right mask leaves off the target.
    """
    return bool((np.isfinite(off).sum(axis=1) >= fewest).mean() > 0.5)
