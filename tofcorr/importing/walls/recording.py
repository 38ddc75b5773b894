"""A recording of walls: one frame for each image and wall, the planes estimated."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import groupby
from pathlib import Path

import numpy as np
import torch

from tofcorr.data.recording import FrameBatch, Recording, iterate_frames
from tofcorr.data.writing import RecordingWriter
from tofcorr.geometry.rays import ray_directions
from tofcorr.importing.walls.finding import FoundWalls, WallView, walls_of_planes
from tofcorr.importing.walls.image_planes import (
    WallOptions,
    near_planes,
    planes_of_image,
    wall_masks,
)

_FEW_PIXELS = 256
"""Cameras of fewer pixels (8 x 8 and the like) see one wall an image, which its target names. Set
by hand: a wall's edge in 16 x 16 pixels still leaves dozens of them on each side."""


def import_walls(
    recording: Recording,
    out: Path | str,
    options: WallOptions | None = None,
    *,
    named: bool | None = None,
    progress: Callable[[int], object] = lambda images: None,
) -> FoundWalls:
    """Find the walls of a recording, and write them as a recording with estimated planes.

    One frame is written for each image and wall, with a mask of its own. The frames of one image
    have its pose, time stamp and `pose_id`, so that no split parts them. Images are read one by
    one: the recording may be larger than memory.

    The recorded hand-eye transform is tried, and decides only what the images leave open.

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
    options, table, camera = options or WallOptions(), recording.frames, recording.camera
    pixels, rays = camera.width * camera.height, ray_directions(camera)
    named = pixels < _FEW_PIXELS if named is None else named
    planes = []
    for batch in iterate_frames(recording):
        images = zip(batch.radial_distance, batch.valid, strict=True)
        planes += [planes_of_image(*image, rays, options, named=named) for image in images]
        progress(len(batch.indices))
    found = walls_of_planes(
        planes,
        pixels,
        table.world_from_tool,
        recording.tool_from_camera,
        options,
        str(recording.path),
        table.target if named else None,
    )
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
        for image, group in groupby(found.views, key=lambda view: view.image):
            views, frame = list(group), np.array([image])
            masks = _masks(recording, views, found, 1e-3 * options.tolerance_mm)
            read = {name: recording.read(name, frame) for name in ("depth", "amplitude", "raw")}
            arrays = {name: array[0] for name, array in read.items() if array is not None}
            depth = arrays.pop("depth")
            # What frames of one image, and of one pose, have in common.
            given = "" if table.pose_id is None else str(table.pose_id[image])
            for view, mask in zip(views, masks, strict=True):
                wall = found.walls[view.wall]
                row = replace(
                    table.row(image),
                    normal_world=wall.normal_world,
                    offset=wall.offset,
                    target=wall.name,
                    pose_id=given or f"image {image}",
                )
                writer.append(depth, row=row, mask=mask, **arrays)
            progress(1)
    return found


def _masks(
    recording: Recording, views: Sequence[WallView], found: FoundWalls, tolerance: float
) -> np.ndarray:
    """Return which pixels of an image look at each of its walls, shape (V, H, W).

    A strip of another wall may be too narrow to be found in this image. Near the crease its pixels
    would pass for the wall beside it, so that none near a wall of other images is used: within two
    tolerances, for beside the camera's error that wall's place in this image is known to 10 to
    20 mm only. Walls whose normals are within 20 degrees of each other do not cross.
    """
    batch: FrameBatch = next(iter(iterate_frames(recording, [views[0].image])))
    distance, valid = batch.radial_distance[0], batch.valid[0]
    rays = ray_directions(recording.camera)
    masks = wall_masks(distance, valid, rays, [view.gradient for view in views], tolerance)
    if views[0].gradient is None:
        return masks
    pose = recording.frames.world_from_tool[views[0].image] @ found.tool_from_camera
    seen = {view.wall for view in views}
    others = [
        (wall.normal_world, -(wall.normal_world @ pose[:3, :3]) / height)
        for number, wall in enumerate(found.walls)
        if number not in seen
        and (height := wall.normal_world @ pose[:3, 3] + wall.offset) > 0
    ]  # fmt: skip
    for k, view in enumerate(views):
        own = found.walls[view.wall].normal_world
        crossing = [plane for normal, plane in others if abs(normal @ own) < np.cos(np.pi / 9)]
        if crossing:
            planes = torch.from_numpy(np.stack(crossing))
            near = near_planes(distance, valid, rays, planes, 2 * tolerance)
            masks[k] &= ~near.any(dim=0).numpy()
    return masks
