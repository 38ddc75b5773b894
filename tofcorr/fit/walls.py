"""Walls that nobody has measured: estimated with the calibration, or alone under a fitted model."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from tofcorr.correction.model import CalibrationModel
from tofcorr.data.recording import FrameBatch, Recording
from tofcorr.errors import CalibrationDataError
from tofcorr.estimation.planes import Walls, plane_through
from tofcorr.pixels.dataset import Dataset
from tofcorr.pixels.sample import pixels_of_image

# Fewest images of a wall. A wall has three unknowns, and one image determines about three, so that
# fewer than three images contribute little to the other unknowns.
_FEWEST_IMAGES = 3
# Recorded planes count as one wall if normal and offset agree to this many decimals: 0.1 mm in the
# offset, 0.1 mrad in the normal, well below the accuracy of any measured wall. Set by hand.
_DECIMALS = 4


class WallNames(NamedTuple):
    """Which wall each frame of a data set shows.

    Attributes:
        of_frame: A number a frame, shape (N,).
        names: The walls' names: the target's, numbered where a target stood in several places.
    """

    of_frame: np.ndarray
    names: list[str]


def name_walls(dataset: Dataset) -> WallNames:
    """Number the walls: frames of one target and one recorded plane show the same wall."""
    planes = np.column_stack([dataset.column("normal_world"), dataset.column("offset")])
    keys = [
        (str(target), *plane)
        for target, plane in zip(dataset.targets, np.round(planes, _DECIMALS).tolist(), strict=True)
    ]
    distinct = sorted(set(keys))
    of_target = [key[0] for key in distinct]
    names = [
        name if of_target.count(name) == 1 else f"{name} ({of_target[: k + 1].count(name)})"
        for k, name in enumerate(of_target)
    ]
    return WallNames(np.array([distinct.index(key) for key in keys]), names)


def recorded_walls(
    dataset: Dataset, frames: Sequence[int] | np.ndarray, found: WallNames
) -> tuple[Walls, np.ndarray]:
    """Return the walls that some frames show, as recorded.

    Returns:
        The walls, and their numbers in `found`, shape (G,).

    Raises:
        CalibrationDataError: A wall has fewer than three of the frames, and its plane was recorded
            as measured. An importer has seen to it that the others have enough.
    """
    frames = np.asarray(frames)
    numbers, first, index, count = np.unique(
        found.of_frame[frames], return_index=True, return_inverse=True, return_counts=True
    )
    fewest = 1 if dataset.planes_are_estimated else _FEWEST_IMAGES
    for place in np.flatnonzero(count < fewest)[:1]:
        name = found.names[numbers[place]]
        raise CalibrationDataError(
            f"{dataset.first.path}: planes: unknown needs at least {_FEWEST_IMAGES} images of each "
            f"wall, '{name}' has {count[place]}. Frames of one wall carry the same target and the "
            "same nx, ny, nz, d in frames.csv; record more, or measure that wall."
        )
    names = "normal_world", "offset", "world_from_tool"
    normal, offset, pose = (dataset.column(name)[frames] for name in names)
    walls = Walls(normal[first], offset[first], torch.from_numpy(index), pose)
    return walls, numbers


def with_walls(dataset: Dataset, found: WallNames, walls: Walls, numbers: np.ndarray) -> Dataset:
    """Return the data set with estimated walls in place of those recorded.

    Frames of a wall that was not estimated keep it as recorded.
    """
    recordings: list[Recording] = []
    start = 0
    for recording in dataset.recordings:
        own = found.of_frame[start : start + recording.num_frames]
        normal = np.array(recording.frames.normal_world)
        offset = np.array(recording.frames.offset)
        for place, number in enumerate(numbers):
            normal[own == number] = walls.normal_world[place].numpy()
            offset[own == number] = float(walls.offset[place])
        table = replace(recording.frames, normal_world=normal, offset=offset)
        recordings.append(replace(recording, frames=table))
        start += recording.num_frames
    return replace(dataset, recordings=tuple(recordings))


@dataclass(frozen=True)
class FoundWalls:
    """Walls that were estimated, and how to put them into a data set.

    Attributes:
        named: Which wall each frame of the data set shows.
        walls: The walls found.
        numbers: Their numbers in `named`, shape (G,).
    """

    named: WallNames
    walls: Walls
    numbers: np.ndarray

    @property
    def names(self) -> list[str]:
        """The names of the walls found."""
        return [self.named.names[number] for number in self.numbers]

    def put_into(self, dataset: Dataset) -> Dataset:
        """Return the data set with the walls found in place of those recorded."""
        return with_walls(dataset, self.named, self.walls, self.numbers)


def wall_summary(names: list[str], walls: Walls) -> list[dict[str, Any]]:
    """Return the walls found, for the report."""
    return [
        {"wall": name, "normal_world": normal, "offset_m": offset}
        for name, normal, offset in zip(
            names, walls.normal_world.tolist(), walls.offset.tolist(), strict=True
        )
    ]


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
    poses = dataset.column("world_from_tool")
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
    corrected = pixels.radial_distance - model.error.error_at(pixels)
    points = rays[used] * corrected[:, None]
    return torch.cat([points, torch.ones_like(points[:, :1])], dim=1)
