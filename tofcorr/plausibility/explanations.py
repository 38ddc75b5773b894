"""The usual mistakes, undone one by one: does one of them explain why points miss their planes?"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import numpy as np

from tofcorr.plausibility import pose_mistakes
from tofcorr.plausibility.alignment import Alignment
from tofcorr.plausibility.free_walls import align_with_free_walls
from tofcorr.plausibility.look import Look
from tofcorr.plausibility.scene import Scene

# Rows by which poses and images may be shifted against each other. Chosen.
_SHIFTS = (1, -1, 2, -2)
# Units that translations, offsets and depth come in, as factors to metres.
_UNITS = ((1e-3, "millimetres"), (1e-2, "centimetres"), (0.0254, "inches"))
# Distance and extent of poses below which a unit is not tried, metres. Chosen.
_NEAREST, _NARROWEST = 0.1, 0.02
# Fewest frames on either side of a change of camera. Chosen: seven unknowns, three from a frame.
_FEWEST_OF_PART = 6
# Fewest pixels off the mask in a frame, and the share of such frames from which on the mask may be
# inverted. Chosen: any plane fits the few pixels that a right mask leaves off the target.
_FEWEST_PIXELS, _MOST_FRAMES = 12, 0.5
# Places where a recording is cut in two, as shares of its frames. Chosen.
_CUTS = (0.5, 0.25, 0.75, 1 / 3, 2 / 3)


@dataclass(frozen=True)
class Explanation:
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
_Try = tuple[str, str, bool, Undo]


def explanations(look: Look) -> Iterator[Explanation]:
    """Yield every mistake that can be undone, with the misfit that is left then."""
    for cause, advice, fatal, undo in (*_of_poses(look), *_of_planes(look), *_of_images(look)):
        undone = undo()
        found = look.aligned(undone) if isinstance(undone, Scene) else undone
        if found is not None and len(found.rms):
            yield Explanation(cause, advice, found, fatal, frees=not isinstance(undone, Scene))


def _of_poses(look: Look) -> Iterator[_Try]:
    scene = look.scene
    if not scene.moves:
        return
    poses = scene.poses

    def posed(changed: np.ndarray) -> Undo:
        return lambda: replace(scene, poses=changed)

    yield (
        "the poses are tool_from_world, the inverse of what the format asks for",
        "invert them",
        True,
        posed(np.linalg.inv(poses)),
    )
    yield (
        "the quaternions are stored as w, x, y, z",
        "write them as qx, qy, qz, qw",
        True,
        posed(pose_mistakes.reordered(poses)),
    )
    yield (
        "the rotations are inverted and the translations are not",
        "write world_from_tool",
        True,
        posed(pose_mistakes.transposed(poses)),
    )
    for shift in _SHIFTS:
        if len(poses) > 3 + 2 * abs(shift):
            yield (
                f"poses and images are shifted by {abs(shift)} "
                f"row{'s' if abs(shift) > 1 else ''} against each other",
                "pair them again: an image or a pose was dropped",
                True,
                lambda shift=shift: _shifted(scene, shift),
            )
    yield (
        "the poses are in the opposite order of the images",
        "reverse one of them",
        True,
        posed(poses[::-1]),
    )
    for axis, name in enumerate("xyz"):
        yield (
            f"the poses are of a left-handed world ({name} turned round)",
            "convert them to a right-handed frame before writing",
            True,
            posed(pose_mistakes.mirrored(poses, axis)),
        )
    for first, second, name in ((1, 2, "y and z"), (0, 1, "x and y"), (0, 2, "x and z")):
        yield (
            f"the poses are of a left-handed world ({name} exchanged)",
            "convert them to a right-handed frame before writing",
            True,
            posed(pose_mistakes.exchanged(poses, first, second)),
        )
    extent = float(np.ptp(poses[:, :3, 3], axis=0).max())
    for factor, unit in _UNITS:
        if factor * extent < _NARROWEST:
            continue
        changed = poses.copy()
        changed[:, :3, 3] *= factor
        yield f"the translations are in {unit}", "divide tx, ty, tz", True, posed(changed)
    changed = poses.copy()
    changed[:, :3, 3] *= 1e3
    yield "the translations are in kilometres", "multiply tx, ty, tz", True, posed(changed)


def _of_planes(look: Look) -> Iterator[_Try]:
    scene = look.scene
    if look.planes != "known":
        return
    yield (
        "the planes' normals nx, ny, nz point the wrong way and d does not",
        "turn nx, ny, nz round",
        True,
        lambda: replace(scene, normal=-scene.normal),
    )
    for factor, unit in _UNITS:
        yield (
            f"the planes' offsets d are in {unit}",
            "write d in metres",
            True,
            lambda factor=factor: replace(scene, offset=factor * scene.offset),
        )
    yield (
        "the recorded planes are wrong or of another frame",
        "measure them again, or train with `planes: unknown`",
        False,
        lambda: align_with_free_walls(scene),
    )
    if not scene.moves:
        yield (
            "the planes are not in the camera's frame, which a recording without robot poses asks "
            "for",
            "write the planes in camera coordinates, or the robot's poses",
            True,
            lambda: look.aligned(replace(scene, moves=True)),
        )
    else:
        yield (
            "two cameras, or one camera mounted twice, are in one recording",
            "split it where the camera was changed",
            True,
            lambda: _in_two_parts(look),
        )


def _of_images(look: Look) -> Iterator[_Try]:
    sample = look.sample
    height, width = sample.recording.camera.height, sample.recording.camera.width
    if height * width < 4:
        return
    row, column = np.divmod(sample.pixel, width)
    flips = (
        ("mirrored left to right", row * width + (width - 1 - column)),
        ("turned upside down", (height - 1 - row) * width + column),
    )
    for words, pixel in flips:
        yield (
            f"the images are {words}",
            "undo the driver's flip before writing",
            True,
            lambda pixel=pixel: look.with_images(sample.stored, pixel),
        )
    if height == width:
        yield (
            "the images are transposed: rows are columns",
            "transpose them before writing",
            True,
            lambda: look.with_images(sample.stored, column * width + row),
        )
    typical = float(np.nanmedian(sample.stored))
    for factor, unit in ((0.3048, "feet"), *_UNITS):
        # A camera that shrinks to a point misses no plane.
        if factor * typical < _NEAREST:
            continue
        yield (
            f"the depth is in {unit}",
            "write metres",
            True,
            lambda factor=factor: look.with_images(factor * sample.stored, sample.pixel),
        )
    off, off_pixel = sample.off_mask, sample.off_pixel
    if off is not None and off_pixel is not None and _seen(off):
        yield (
            "the mask is inverted: it is 0 on the target",
            "write 1 where a pixel looks at the target",
            True,
            lambda: look.with_images(off, off_pixel),
        )


def _seen(off: np.ndarray) -> bool:
    """Return whether most frames have enough pixels (F, P) off the mask to say it is inverted."""
    enough = np.isfinite(off).sum(axis=1) >= _FEWEST_PIXELS
    return bool(enough.mean() > _MOST_FRAMES)


def _shifted(scene: Scene, shift: int) -> Scene:
    """Return the frames that have a pose `shift` rows on, with that pose and their own plane."""
    number = np.arange(len(scene.poses))
    inside = (number + shift >= 0) & (number + shift < len(number))
    return replace(scene.some(inside), poses=scene.poses[number[inside] + shift])


def _in_two_parts(look: Look) -> Alignment | None:
    """Return the alignment of the two sides of a cut, each by itself, at the best of some cuts."""
    count = len(look.scene.poses)
    found: list[Alignment] = []
    for share in _CUTS:
        cut = round(share * count)
        if min(cut, count - cut) < _FEWEST_OF_PART:
            continue
        sides = [
            look.aligned(look.scene.some(part)) for part in (np.arange(cut), np.arange(cut, count))
        ]
        if all(side is not None for side in sides):
            rms = np.concatenate([side.rms for side in sides if side is not None])
            angle = np.concatenate([side.angle for side in sides if side is not None])
            found.append(Alignment(np.eye(4), 0.0, 0.0, rms, angle))
    return min(found, key=lambda one: one.misfit, default=None)
