"""The usual mistakes in poses, planes and images: one list of what undoes them, and one judge.

Does one of them, undone, explain why points miss their planes? `importing` undoes some of them
before a recording is written, and words its advice by its own options.
"""

from collections.abc import Callable, Iterator
from functools import partial
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from tofcorr.estimation.robust import LEVEL, f_tail
from tofcorr.plausibility.alignment import Alignment, Scene, align_with_free_walls
from tofcorr.plausibility.finding import CAMERA, FAR_OFF, SPOILS
from tofcorr.plausibility.look import Look

FAR_BETTER = 0.5
"""A mistake is named if undoing it leaves at most this share of the misfit. Chosen: a mistake
undone leaves a third and less, a second mistake nearly all."""


class Mistake(NamedTuple):
    """A usual mistake in poses or images.

    Attributes:
        cause: What it is, to follow "the likely cause: ".
        advice: What to do.
        undo: Returns poses or images without it.
    """

    cause: str
    advice: str
    undo: Callable[[np.ndarray], np.ndarray]


def reordered(poses: np.ndarray) -> np.ndarray:
    """Return the poses whose quaternions, read as x y z w, were written as w x y z."""
    quaternions = Rotation.from_matrix(poses[:, :3, :3]).as_quat()
    changed = poses.copy()
    changed[:, :3, :3] = Rotation.from_quat(np.roll(quaternions, -1, axis=1)).as_matrix()
    return changed


def transposed(poses: np.ndarray) -> np.ndarray:
    """Return the poses with their rotations inverted, their translations as they are."""
    changed = poses.copy()
    changed[:, :3, :3] = poses[:, :3, :3].mT
    return changed


def of_other_axes(poses: np.ndarray, axes: np.ndarray) -> np.ndarray:
    """Return the poses in a world, and of a tool, whose axes are the rows of a (4, 4) matrix.

    Axes that are longer or shorter, all alike, change the unit of the translations.
    """
    return axes @ poses @ np.linalg.inv(axes)


_UNITS = {"millimetres": 1e-3, "centimetres": 1e-2, "inches": 0.0254}
_AXES = {
    **{f"{'xyz'[axis]} turned round": np.diag((-1.0) ** np.eye(4)[axis]) for axis in range(3)},
    "y and z exchanged": np.eye(4)[[0, 2, 1, 3]],
    "x and y exchanged": np.eye(4)[[1, 0, 2, 3]],
    "x and z exchanged": np.eye(4)[[2, 1, 0, 3]],
}
_DRIVER = "undo that before writing"
_INVERSE = "the poses are tool_from_world, the inverse of what the format asks for"
_ORDER = "the quaternions are stored as w, x, y, z"
_TURNED = "the rotations are inverted and the translations are not"
_OPPOSITE = "the poses are in the opposite order of the images"
IN_POSES: dict[str, Mistake] = {
    "inverted": Mistake(_INVERSE, "invert them", np.linalg.inv),
    "quaternions": Mistake(_ORDER, "write them as qx, qy, qz, qw", reordered),
    "rotations": Mistake(_TURNED, "write world_from_tool", transposed),
    **{
        f"shifted {rows:+d}": Mistake(
            f"poses and images are shifted by {words} against each other",
            "pair them again: an image or a pose was dropped",
            partial(np.roll, shift=rows, axis=0),
        )
        for rows, words in {1: "1 row", -1: "1 row", 2: "2 rows", -2: "2 rows"}.items()
    },
    "reversed": Mistake(_OPPOSITE, "reverse one of them", np.flipud),
    **{
        name: Mistake(
            f"the poses are of a left-handed world ({name})",
            "convert them to a right-handed frame before writing",
            partial(of_other_axes, axes=axes),
        )
        for name, axes in _AXES.items()
    },
    **{
        f"in {unit}": Mistake(
            f"the translations are in {unit}",
            f"{'divide' if factor < 1 else 'multiply'} tx, ty, tz",
            partial(of_other_axes, axes=np.diag([factor, factor, factor, 1.0])),
        )
        for unit, factor in (*_UNITS.items(), ("kilometres", 1e3))
    },
}
"""Mistakes in poses (N, 4, 4) by name, the likely ones first."""
IN_IMAGES: dict[str, Mistake] = {
    words: Mistake(f"the images are {words}", _DRIVER, undo)
    for words, undo in (
        ("mirrored left to right", np.fliplr),
        ("turned upside down", np.flipud),
        ("transposed", np.transpose),
        ("mirrored along a diagonal", lambda image: np.rot90(image, 2).T),
        ("turned to the right", np.rot90),
        ("turned by half a turn", partial(np.rot90, k=2)),
        ("turned to the left", partial(np.rot90, k=3)),
    )
}
"""The same in images (H, W), whatever their pixels hold: all symmetries of a square. Where a robot
moves the camera, its hand-eye transform holds a mere turn."""
IN_DEPTH: dict[str, Mistake] = {
    f"in {unit}": Mistake(f"the depth is in {unit}", "write metres", partial(np.multiply, factor))
    for unit, factor in (("feet", 0.3048), *_UNITS.items())
}
"""The same in depths, of any shape."""

Explanation = tuple[str, str, Alignment, bool]
"""What the mistake is, to follow "the likely cause: ", what to do, the alignment without it, and
whether undoing it frees unknowns, so that some of the misfit falls in any case."""


def best_explanations(look: Look) -> list[Explanation]:
    """Return the explanations that are about as good as the best and far better than none.

    They leave no more than errors of a camera, or the noise of its walls, and take off what spoils
    a fit. What is compared is a share of the distances: a unit that makes all of them short makes
    every misfit small. Of several, the first listed that comes near the best is named: within four
    thirds; one that frees unknowns comes last.
    """
    # Of as many guesses none is that much better by chance; a frame tells three numbers, of which
    # an alignment takes eight.
    given, tried, freedom = look.given, list(explanations(look)), 3 * len(look.given.rms) - 8
    better = [
        one
        for one in tried
        if (found := one[2]).badness <= min(given.badness - SPOILS, max(CAMERA, 4 * look.noise))
        and found.relative <= FAR_BETTER * given.relative
        and (not one[3] or found.misfit <= FAR_BETTER * given.misfit)
        and len(tried) * f_tail((given.relative / found.relative) ** 2, freedom, freedom) < LEVEL
    ]
    least = min((one[2].relative for one in better), default=0.0)
    near = [one for one in better if 3 * one[2].relative <= 4 * least]
    return sorted(near, key=lambda one: one[3])


def explanations(look: Look) -> Iterator[Explanation]:
    """Yield every mistake that can be undone, with the alignment then."""
    for cause, advice, undone in (*_of_poses(look), *_of_planes(look), *_of_images(look)):
        frees = not isinstance(undone, Scene)
        found = undone if frees else look.aligned(undone)
        if found is not None:
            yield cause, advice, found, frees


def _of_poses(look: Look) -> Iterator[tuple[str, str, Scene]]:
    """Yield mistakes in poses; none that shrinks them to an extent of errors of a camera."""
    scene = look.scene
    if not scene.moves:
        return
    narrowest = min(CAMERA, float(np.ptp(scene.poses[:, :3, 3], axis=0).max()))
    for name, (cause, advice, undo) in IN_POSES.items():
        poses = undo(scene.poses)
        # Frames at the end have no pose of theirs.
        too_few = name.startswith("shifted") and len(poses) <= 3 + 2 * abs(int(name[-2:]))
        if not too_few and np.ptp(poses[:, :3, 3], axis=0).max() >= narrowest:
            yield cause, advice, scene.changed(poses=poses)


WRONG_PLANES = "the recorded planes are wrong or of another frame"
"""Planes that are a few degrees off are no reason to refuse a recording."""


def _of_planes(look: Look) -> Iterator[tuple[str, str, Scene | Alignment | None]]:
    """Yield mistakes in planes, and then those in what else a fit takes as known."""
    scene = look.scene
    if look.planes != "known":
        return
    turned = "the planes' normals nx, ny, nz point the wrong way and d does not"
    yield turned, "turn nx, ny, nz round", scene.changed(normal=-scene.normal)
    for unit, factor in _UNITS.items():
        in_metres = scene.changed(offset=factor * scene.offset)
        yield f"the planes' offsets d are in {unit}", "write d in metres", in_metres
    free = align_with_free_walls(scene)
    yield WRONG_PLANES, "measure them again, or train with `planes: unknown`", free
    if not scene.moves:
        cause = "the planes are not in the camera's frame, which a recording without robot asks for"
        advice = "write the planes in camera coordinates, or the robot's poses"
        yield cause, advice, look.aligned(scene.changed(moves=True))


def _of_images(look: Look) -> Iterator[tuple[str, str, Scene]]:
    """Yield mistakes in images.

    A unit is not tried that leaves a distance as short as pixels may be off: a camera that shrinks
    to a point misses no plane. To say that the mask is inverted, most frames must have twelve
    pixels off it: any plane fits the few that a right mask leaves off the target.
    """
    camera = look.recording.camera
    if camera.height * camera.width < 4:
        return
    number = np.arange(camera.height * camera.width).reshape(camera.height, camera.width)
    for cause, advice, undo in IN_IMAGES.values():
        if (undone := undo(number)).shape == number.shape:
            pixel = undone.reshape(-1)[look.pixel]
            yield cause, advice, look.with_images(look.stored, pixel)
    for cause, advice, undo in IN_DEPTH.values():
        if np.nanmedian(depth := undo(look.stored)) >= FAR_OFF:
            yield cause, advice, look.with_images(depth, look.pixel)
    off = look.off_mask
    if off is not None and (np.isfinite(off).sum(axis=1) >= 12).mean() > 0.5:
        inverted = "the mask is inverted: it is 0 on the target"
        advice = "write 1 where a pixel looks at the target"
        yield inverted, advice, look.with_images(off, look.off_pixel)
