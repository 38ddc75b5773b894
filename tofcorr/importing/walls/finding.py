"""Walls of a recording that has robot poses and depth, and no measured planes."""

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from tofcorr.data.frames import iterate_frames
from tofcorr.data.recording import Recording
from tofcorr.errors import CalibrationDataError
from tofcorr.geometry.camera import CameraIntrinsics
from tofcorr.geometry.rays import ray_directions
from tofcorr.importing.walls.found import FoundWalls, summarise
from tofcorr.importing.walls.image_plane import ImagePlane
from tofcorr.importing.walls.image_planes import find_planes, only_plane
from tofcorr.importing.walls.joint import Joint
from tofcorr.importing.walls.matching import match
from tofcorr.importing.walls.options import WallOptions
from tofcorr.importing.walls.seen_planes import SeenPlanes, seen_planes
from tofcorr.importing.walls.single_ray import match_single_ray

# Cameras of fewer pixels (8 x 8 and the like) see one wall an image, which its target names. Set by
# hand: a wall's edge in 16 x 16 pixels still leaves dozens of them on each side.
_FEW_PIXELS = 256
# With fewer images nothing is found: the rotation of the hand-eye and a wall's normal have five
# unknowns, and each image gives two; three images determine them, and the fourth is the check.
_FEWEST_IMAGES = 4

# Of the search for planes: every run gives the same. Its value was not chosen.
_SEED = 0


@dataclass(frozen=True, kw_only=True)
class PosedImages:
    """Images and the robot poses they were taken from.

    Attributes:
        origin: Where they come from, for messages.
        camera: The camera's intrinsics.
        world_from_tool: Poses, shape (N, 4, 4), metres.
        images: For each image distances along the ray, shape (H, W), metres, and where they are
            valid; nothing where their planes are known already.
        targets: The name of the one wall that each image shows, shape (N,); None: walls are
            looked for.
    """

    origin: str
    camera: CameraIntrinsics
    world_from_tool: np.ndarray
    images: Iterable[tuple[Tensor, Tensor]] = ()
    targets: np.ndarray | None = None


def find_walls(
    recording: Recording,
    options: WallOptions | None = None,
    *,
    named: bool | None = None,
    progress: Callable[[int], object] = lambda images: None,
) -> FoundWalls:
    """Find the walls that the images of a recording show, and estimate where they stand.

    The planes of `frames.csv` are not looked at. The recorded hand-eye transform is tried, and
    decides only what the images leave open.

    Args:
        recording: Depth images and robot poses.
        options: How planes are found and matched.
        named: Whether each image shows one wall, which its `target` names. None: it does if the
            camera has fewer than 256 pixels.
        progress: Called with the number of images that were just searched.

    Raises:
        CalibrationDataError: No robot moves, or there is no wall in the images.
    """
    pixels = recording.camera.width * recording.camera.height
    named = pixels < _FEW_PIXELS if named is None else named
    posed = PosedImages(
        origin=str(recording.path),
        camera=recording.camera,
        world_from_tool=recording.frames.world_from_tool,
        images=_images(recording, progress),
        targets=recording.frames.target if named else None,
    )
    return find_walls_in(posed, recording.tool_from_camera, options)


def find_walls_in(
    posed: PosedImages, guess: np.ndarray, options: WallOptions | None = None
) -> FoundWalls:
    """Find the walls that images from known robot poses show, read one at a time.

    Args:
        posed: The images and their poses.
        guess: A hand-eye transform (4, 4); it decides only what the images leave open.
        options: How planes are found and matched.

    Raises:
        CalibrationDataError: No robot moves, or there is no wall in the images.
    """
    options = options or WallOptions()
    _refuse_still(posed)
    rays, named = ray_directions(posed.camera), posed.targets is not None
    planes = [
        planes_of_image(distance, valid, rays, options, named=named)
        for distance, valid in posed.images
    ]
    return walls_of_planes(posed, planes, guess, options)


def planes_of_image(
    distance: Tensor, valid: Tensor, rays: Tensor, options: WallOptions, *, named: bool = False
) -> list[ImagePlane]:
    """Find the planes of one image.

    Args:
        distance: Along the ray, shape (H, W), metres; undefined where not `valid`.
        valid: Where there is a measurement, shape (H, W).
        rays: Unit rays, shape (H, W, 3).
        options: How planes are found.
        named: Whether the image shows one wall and nothing else.
    """
    if named:
        plane = only_plane(distance, valid, rays)
        return [] if plane is None else [plane]
    # The same draws for every image: an image's planes do not depend on its number.
    return find_planes(distance, valid, rays, options, torch.Generator().manual_seed(_SEED))


def walls_of_planes(
    posed: PosedImages,
    images: Sequence[Sequence[ImagePlane]],
    guess: np.ndarray,
    options: WallOptions,
) -> FoundWalls:
    """Find the walls that the planes of images from known robot poses show.

    Args:
        posed: The images' camera and poses; the images themselves are not looked at.
        images: The planes of each image, as `planes_of_image` finds them.
        guess: A hand-eye transform (4, 4); it decides only what the images leave open.
        options: How planes were found, and are matched.

    Raises:
        CalibrationDataError: No robot moves, or there is no wall in the images.
    """
    _refuse_still(posed)
    names, labels = None, None
    if posed.targets is not None:
        names, index = np.unique(posed.targets, return_inverse=True)
        labels = torch.from_numpy(index)
    pixels = posed.camera.width * posed.camera.height
    poses = torch.from_numpy(np.array(posed.world_from_tool))
    planes = seen_planes(images, poses, pixels, labels)
    if names is not None and planes.label is not None:
        # A wall without a single measurement has no place.
        used, label = torch.unique(planes.label, return_inverse=True)
        names, planes = names[used.numpy()], replace(planes, label=label)
    joint = _matched(planes, torch.from_numpy(np.array(guess)), options, posed, len(images))
    return summarise(options, images, planes, joint, names)


def _refuse_still(posed: PosedImages) -> None:
    if (posed.world_from_tool == posed.world_from_tool[0]).all():
        raise CalibrationDataError(
            f"{posed.origin}: walls are found in images from several robot poses, and "
            "world_from_tool is the same for every image. Give the robot's poses."
        )


def _matched(
    planes: SeenPlanes, guess: Tensor, options: WallOptions, posed: PosedImages, count: int
) -> Joint:
    seeing = len(planes.image.unique())
    if seeing < _FEWEST_IMAGES:
        raise CalibrationDataError(
            f"{posed.origin}: {seeing} of {count} images show anything flat, {_FEWEST_IMAGES} are "
            f"needed; a plane must cover {100 * options.least_share:g} % of an image to within "
            f"{options.tolerance_mm:g} mm."
        )
    if posed.camera.width * posed.camera.height == 1:
        return match_single_ray(planes, guess)
    joint = match(planes, guess, options.fewest_images)
    if not bool((joint.wall >= 0).any()):
        raise CalibrationDataError(
            f"{posed.origin}: {len(planes)} planes were found in {count} images, and no hand-eye "
            f"transform makes those of {options.fewest_images} images one wall. Do the poses "
            "belong to the images, and are they world_from_tool in metres?"
        )
    return joint


def _images(
    recording: Recording, progress: Callable[[int], object]
) -> Iterator[tuple[Tensor, Tensor]]:
    for batch in iterate_frames(recording):
        yield from zip(batch.radial_distance, batch.valid, strict=True)
        progress(len(batch.indices))
