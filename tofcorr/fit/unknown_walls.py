"""Walls that nobody has measured: found together with the calibration, and put into its place."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
import torch

from tofcorr.data.recording import Recording
from tofcorr.errors import CalibrationDataError
from tofcorr.estimation.planes import Walls
from tofcorr.pixels.dataset import Dataset

# A wall of fewer images says next to nothing beyond its own place.
_FEWEST_IMAGES = 3
# Recorded planes that differ by less are one wall: decimals of normal and offset.
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
    """Tell walls apart by target and recorded plane."""
    planes = np.concatenate(
        [
            np.column_stack([recording.frames.normal_world, recording.frames.offset])
            for recording in dataset.recordings
        ]
    )
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
        CalibrationDataError: A wall has fewer than three of the frames.
    """
    frames = np.asarray(frames)
    numbers, first, index, count = np.unique(
        found.of_frame[frames], return_index=True, return_inverse=True, return_counts=True
    )
    for place in np.flatnonzero(count < _FEWEST_IMAGES)[:1]:
        name = found.names[numbers[place]]
        raise CalibrationDataError(
            f"{dataset.first.path}: planes: unknown needs at least {_FEWEST_IMAGES} images of each "
            f"wall, '{name}' has {count[place]}. Frames of one wall carry the same target and the "
            "same nx, ny, nz, d in frames.csv; record more, or measure that wall."
        )
    tables = [recording.frames for recording in dataset.recordings]
    normal, offset, pose = (
        torch.from_numpy(np.concatenate([getattr(table, name) for table in tables])[frames])
        for name in ("normal_world", "offset", "world_from_tool")
    )
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


def wall_summary(names: list[str], walls: Walls) -> list[dict[str, Any]]:
    """Return the walls found, for the report."""
    return [
        {"wall": name, "normal_world": normal, "offset_m": offset}
        for name, normal, offset in zip(
            names, walls.normal_world.tolist(), walls.offset.tolist(), strict=True
        )
    ]
