"""Walls that nobody has measured: estimated with the calibration, or alone under a fitted model."""

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from tofcorr.correction.model import CalibrationModel
from tofcorr.errors import CalibrationDataError
from tofcorr.estimation.planes import Walls
from tofcorr.geometry.rays import planes_through
from tofcorr.pixels.dataset import Dataset, Frames
from tofcorr.pixels.sample import pixels_of_image


@dataclass(frozen=True)
class FoundWalls:
    """Walls of some frames, and which wall each frame of a data set shows.

    Attributes:
        of_frame: The number of its wall, for each frame of the data set, shape (N,).
        names: Of all walls of the data set, see `name_walls`.
        walls: The walls of some frames, G of them.
        numbers: Their numbers among all walls, shape (G,).
    """

    of_frame: np.ndarray
    names: list[str]
    walls: Walls
    numbers: np.ndarray

    def put_into(self, dataset: Dataset) -> Dataset:
        """Return the data set with these walls in place of those recorded.

        Frames of other walls keep theirs as recorded.
        """
        normal, offset = (dataset.column(name).numpy() for name in ("normal_world", "offset"))
        for place, number in enumerate(self.numbers):
            normal[self.of_frame == number] = self.walls.normal_world[place].numpy()
            offset[self.of_frame == number] = float(self.walls.offset[place])
        return dataset.with_columns(normal_world=normal, offset=offset)

    def summary(self) -> list[dict[str, Any]]:
        """Return the walls, for the report."""
        planes = self.walls.normal_world.tolist(), self.walls.offset.tolist()
        return [
            {"wall": self.names[number], "normal_world": normal, "offset_m": offset}
            for number, normal, offset in zip(self.numbers, *planes, strict=True)
        ]


def name_walls(dataset: Dataset) -> tuple[np.ndarray, list[str]]:
    """Number the walls: frames of one target and one recorded plane show the same wall.

    Returns:
        A number a frame, shape (N,); and the walls' names: the target's, numbered where a target
        stood in several places.
    """
    planes = np.column_stack([dataset.column("normal_world"), dataset.column("offset")])
    # To 0.1 mm in the offset and 0.1 mrad in the normal, well below the accuracy of any wall.
    rounded = np.round(planes, 4).tolist()
    keys = [(str(name), *plane) for name, plane in zip(dataset.targets, rounded, strict=True)]
    distinct = sorted(set(keys))
    of_target = [key[0] for key in distinct]
    names = [
        name if of_target.count(name) == 1 else f"{name} ({of_target[: k + 1].count(name)})"
        for k, name in enumerate(of_target)
    ]
    return np.array([distinct.index(key) for key in keys]), names


def recorded_walls(dataset: Dataset, frames: Frames) -> FoundWalls:
    """Return the walls that some frames show, as recorded.

    Raises:
        CalibrationDataError: A wall has fewer than three of the frames, and its plane was recorded
            as measured. An importer has seen to it that the others have enough.
    """
    of_frame, names = name_walls(dataset)
    frames = np.asarray(frames)
    numbers, first, index, count = np.unique(
        of_frame[frames], return_index=True, return_inverse=True, return_counts=True
    )
    # A wall has three unknowns, and one image determines about three: fewer than three images
    # contribute little to the other unknowns.
    for place in np.flatnonzero(count < (1 if dataset.planes_are_estimated else 3))[:1]:
        needed = "at least 3 images of each wall (target and plane in frames.csv)"
        said = f"planes: unknown needs {needed}, '{names[numbers[place]]}' has {count[place]}"
        raise CalibrationDataError(f"{dataset.first.path}: {said}. Record more, or measure.")
    normal, offset, pose = dataset.planes_and_poses(frames)
    walls = Walls(normal[first], offset[first], torch.from_numpy(index), pose)
    return FoundWalls(of_frame, names, walls, numbers)


def lone_walls(dataset: Dataset, frames: Frames) -> Walls:
    """Return a wall for each frame, as recorded."""
    normal, offset, pose = dataset.planes_and_poses(frames)
    return Walls(normal, offset, torch.arange(len(pose)), pose)


def with_every_wall(dataset: Dataset, found: FoundWalls | None, model: CalibrationModel) -> Dataset:
    """Return the data set with the walls found, and the others estimated alone under a model.

    Recorded planes that were measured stay where no wall was found.

    Args:
        dataset: The recordings.
        found: Walls of the training frames; None: the recorded planes were used.
        model: Error model and hand-eye transform.
    """
    if found is None:
        return dataset
    dataset = found.put_into(dataset)
    frames = np.flatnonzero(~np.isin(found.of_frame, found.numbers))
    if not len(frames) or not dataset.planes_are_estimated:
        return dataset
    return walls_alone(dataset, frames, model).put_into(dataset)


def walls_alone(dataset: Dataset, frames: Frames, model: CalibrationModel) -> FoundWalls:
    """Return the walls of some frames, each the plane of least squares through corrected points.

    Args:
        dataset: The recordings; of their planes only which are the same counts.
        frames: Global numbers of the frames.
        model: Error model and hand-eye transform.
    """
    of_frame, names = name_walls(dataset)
    frames = np.asarray(frames)
    numbers, index = np.unique(of_frame[frames], return_inverse=True)
    poses = dataset.column("world_from_tool")
    world_from_camera = poses @ model.hand_eye().detach()
    # Sums of (x, 1)(x, 1)^T over the points of each wall.
    points = torch.zeros(len(numbers), 4, 4, dtype=torch.float64)
    viewpoint = torch.zeros(len(numbers), 3, dtype=torch.float64)
    rays = dataset.ray_directions().flatten(0, 1)
    for batch in dataset.batches(frames):
        for k, frame in enumerate(batch.indices.tolist()):
            pose, wall = world_from_camera[frame], int((numbers < of_frame[frame]).sum())
            used = batch.valid[k].flatten().nonzero()[:, 0]
            pixels = pixels_of_image(batch, k, used)
            distance = pixels.radial_distance - model.error.error_at(pixels)
            corrected = rays[used] * distance[:, None]
            own = torch.cat([corrected, torch.ones_like(corrected[:, :1])], dim=1)
            points[wall] += pose @ (own.T @ own) @ pose.T
            viewpoint[wall] += pose[:3, 3] / int((index == wall).sum())
    seen = points[:, 3, 3] >= 3
    normal, offset = planes_through(points[seen], viewpoint[seen])
    kept = torch.from_numpy(index)
    walls = Walls(normal, offset, kept[seen[kept]], poses[torch.from_numpy(frames)][seen[kept]])
    return FoundWalls(of_frame, names, walls, numbers[seen.numpy()])
