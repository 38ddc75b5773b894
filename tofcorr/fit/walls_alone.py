"""Walls estimated alone, under a fitted model: those that no training image shows.

An importer's estimate of a wall is a start for a fit and no more. Where the fit did not estimate
the wall, its images could otherwise be judged against nothing better.
"""

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from tofcorr.correction.model import CalibrationModel
from tofcorr.data.frames import FrameBatch
from tofcorr.estimation.planes import Walls
from tofcorr.estimation.planes_alone import plane_through
from tofcorr.fit.result import Fit
from tofcorr.fit.unknown_walls import FoundWalls, WallNames
from tofcorr.pixels.dataset import Dataset
from tofcorr.pixels.image_pixels import error_at, pixels_of_image


def with_walls_of(dataset: Dataset, result: Fit) -> Dataset:
    """Return the data set with the walls that a fit estimated, if it did.

    Walls of no training image are estimated alone, under the fitted model, where the recorded
    planes are estimates themselves.
    """
    return dataset if result.walls is None else with_every_wall(dataset, result.walls, result.model)


def with_every_wall(dataset: Dataset, found: FoundWalls, model: CalibrationModel) -> Dataset:
    """Return the data set with the walls found, and the others estimated alone under a model.

    Recorded planes that were measured stay where no wall was found.

    Args:
        dataset: The recordings.
        found: Walls of the training frames.
        model: Error model and hand-eye transform.
    """
    dataset = found.put_into(dataset)
    unseen = np.setdiff1d(found.named.of_frame, found.numbers)
    if not len(unseen) or not dataset.planes_are_estimated:
        return dataset
    frames = np.flatnonzero(np.isin(found.named.of_frame, unseen))
    return walls_alone(dataset, found.named, frames, model).put_into(dataset)


def walls_alone(
    dataset: Dataset, named: WallNames, frames: Sequence[int] | np.ndarray, model: CalibrationModel
) -> FoundWalls:
    """Return the walls of some frames, each the plane of least squares through corrected points.

    Args:
        dataset: The recordings; their planes are not looked at.
        named: Which wall each frame shows.
        frames: Global numbers of the frames.
        model: Error model and hand-eye transform.
    """
    frames = np.asarray(frames)
    numbers, index = np.unique(named.of_frame[frames], return_inverse=True)
    poses = torch.from_numpy(
        np.concatenate([one.frames.world_from_tool for one in dataset.recordings])
    )
    world_from_camera = poses @ model.hand_eye().detach()
    points = torch.zeros(len(numbers), 4, 4, dtype=torch.float64)
    viewpoint = torch.zeros(len(numbers), 3, dtype=torch.float64)
    rays = dataset.ray_directions().flatten(0, 1)
    wall_of = dict(zip(frames.tolist(), index.tolist(), strict=True))
    for batch in dataset.batches(frames):
        for k, frame in enumerate(batch.indices.tolist()):
            pose, wall = world_from_camera[frame], wall_of[frame]
            own = _corrected_points(batch, k, rays, model)
            points[wall] += pose @ (own.T @ own) @ pose.T
            viewpoint[wall] += pose[:3, 3] / int((index == wall).sum())
    seen = points[:, 3, 3] >= 3
    planes = [plane_through(points[wall], viewpoint[wall]) for wall in seen.nonzero()[:, 0]]
    kept = torch.from_numpy(index)
    walls = Walls(
        torch.stack([normal for normal, _ in planes]) if planes else torch.zeros(0, 3).double(),
        torch.stack([offset for _, offset in planes]) if planes else torch.zeros(0).double(),
        kept[seen[kept]],
        poses[torch.from_numpy(frames)][seen[kept]],
    )
    return FoundWalls(named, walls, numbers[seen.numpy()])


def _corrected_points(batch: FrameBatch, k: int, rays: Tensor, model: CalibrationModel) -> Tensor:
    """Return the corrected points (x, 1) of image k in the camera frame, shape (M, 4), metres."""
    used = batch.valid[k].flatten().nonzero()[:, 0]
    pixels = pixels_of_image(batch, k, used)
    corrected = pixels.radial_distance - error_at(model.error, pixels)
    points = rays[used] * corrected[:, None]
    return torch.cat([points, torch.ones_like(points[:, :1])], dim=1)
