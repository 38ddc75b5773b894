"""A recording of walls: one frame for each image and wall, the planes estimated."""

from collections.abc import Callable, Iterable
from dataclasses import replace
from itertools import groupby
from pathlib import Path

import numpy as np
import torch

from tofcorr.data.frames import FrameBatch, iterate_frames
from tofcorr.data.recording import Recording
from tofcorr.data.table import FrameRow, FrameTable
from tofcorr.data.writing import RecordingWriter
from tofcorr.geometry.rays import ray_directions
from tofcorr.importing.walls.finding import find_walls
from tofcorr.importing.walls.found import FoundWalls, WallView
from tofcorr.importing.walls.image_planes import near_planes, plane_masks
from tofcorr.importing.walls.options import WallOptions

# Pixels within this many tolerances of a wall that was found in other images only are not used:
# beside the camera's error, that wall's place in this image is known to 10 to 20 mm only. Chosen.
_UNSEEN = 2.0
# Walls whose normals have a larger cosine between them count as parallel: 20 degrees. Chosen.
_PARALLEL = 0.94


def import_walls(
    recording: Recording,
    out: Path | str,
    options: WallOptions | None = None,
    *,
    named: bool | None = None,
    progress: Callable[[int], object] = lambda images: None,
) -> FoundWalls:
    """Find the walls of a recording, and write them as a recording with estimated planes.

    Args:
        recording: Depth images and robot poses; its planes are not looked at.
        out: Where the new recording shall appear. Nothing may be there yet.
        options: How planes are found and matched.
        named: Whether each image shows one wall, which its `target` names. None: it does if the
            camera has fewer than 256 pixels.
        progress: Called with the number of images just searched or written: twice each.

    Raises:
        CalibrationDataError: No robot moves, there is no wall in the images, or `out` exists.
    """
    options = options or WallOptions()
    found = find_walls(recording, options, named=named, progress=progress)
    write_walls(recording, found, out, options, progress=progress)
    return found


def write_walls(
    recording: Recording,
    found: FoundWalls,
    out: Path | str,
    options: WallOptions,
    *,
    progress: Callable[[int], object] = lambda images: None,
) -> None:
    """Write one frame for each image and wall, with a mask of its own.

    The frames of one image have its pose, time stamp and `pose_id`, so that no split parts them.
    Images are read one by one: the recording may be larger than memory.

    Args:
        recording: The images.
        found: Their walls.
        out: Where the new recording shall appear.
        options: Those that the walls were found with.
        progress: Called with the number of images just written.
    """
    with RecordingWriter(
        out,
        camera=recording.camera,
        depth_kind=recording.depth_kind,
        modulation_frequency=recording.modulation_frequency,
        saturation_amplitude=recording.saturation_amplitude,
        tool_from_camera=found.tool_from_camera,
        planes="estimated",
        frame_names=recording.frame_names,
    ) as writer:
        pose_ids = _pose_ids(recording.frames)
        for image, group in groupby(found.views, key=lambda view: view.image):
            views = list(group)
            frame = np.array([image])
            masks = _masks(recording, views, found, options)
            read = {name: recording.read(name, frame) for name in ("depth", "amplitude", "raw")}
            arrays = {name: array[0] for name, array in read.items() if array is not None}
            depth = arrays.pop("depth")
            for view, mask in zip(views, masks, strict=True):
                row = _row(recording.frames, view, found, pose_ids[image])
                writer.append(depth, row=row, mask=mask, **arrays)
            progress(1)


def _masks(
    recording: Recording, views: list[WallView], found: FoundWalls, options: WallOptions
) -> Iterable[np.ndarray]:
    """Return which pixels of an image look at each of its walls.

    A strip of another wall may be too narrow to be found in this image. Near the crease its pixels
    would pass for the wall beside it, so that none near a wall of other images is used.
    """
    batch: FrameBatch = next(iter(iterate_frames(recording, [views[0].image])))
    distance, valid = batch.radial_distance[0], batch.valid[0]
    gradients = [view.gradient for view in views if view.gradient is not None]
    if not gradients:
        return [valid.numpy()] * len(views)
    rays = ray_directions(recording.camera)
    tolerance = options.tolerance_mm * 1e-3
    stacked = torch.from_numpy(np.stack(gradients))
    masks = plane_masks(distance, valid, rays, stacked, tolerance)
    pose = recording.frames.world_from_tool[views[0].image] @ found.tool_from_camera
    for k, view in enumerate(views):
        others = _unseen(view, views, found, pose)
        masks[k] &= ~near_planes(distance, valid, rays, others, _UNSEEN * tolerance).any(dim=0)
    return masks.numpy()


def _unseen(
    view: WallView, views: list[WallView], found: FoundWalls, world_from_camera: np.ndarray
) -> torch.Tensor:
    """Return the planes g . x = 1 of walls not found in an image that could cross one seen, (L, 3).

    Parallel walls do not cross.
    """
    seen, own = {one.wall for one in views}, found.walls[view.wall].normal_world
    rotation, place = world_from_camera[:3, :3], world_from_camera[:3, 3]
    planes = [
        -(wall.normal_world @ rotation) / (wall.normal_world @ place + wall.offset)
        for number, wall in enumerate(found.walls)
        if number not in seen
        and abs(wall.normal_world @ own) < _PARALLEL
        and wall.normal_world @ place + wall.offset > 0
    ]
    return torch.from_numpy(np.array(planes, dtype=np.float64).reshape(-1, 3))


def _row(table: FrameTable, view: WallView, found: FoundWalls, pose_id: str) -> FrameRow:
    wall = found.walls[view.wall]
    return replace(
        table.row(view.image),
        normal_world=wall.normal_world,
        offset=wall.offset,
        target=wall.name,
        pose_id=pose_id,
    )


def _pose_ids(table: FrameTable) -> list[str]:
    """Return what frames of one image, and of one pose, have in common."""
    own = [f"image {k}" for k in range(len(table))]
    if table.pose_id is None:
        return own
    return [str(given) or name for given, name in zip(table.pose_id, own, strict=True)]
