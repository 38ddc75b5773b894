"""What is known of the frames besides their images: one row, and all rows as arrays."""

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import Self

import numpy as np

from tofcorr.conditions import OPTIONAL_CONDITIONS, Conditions


@dataclass(frozen=True, kw_only=True, eq=False)
class FrameRow(Conditions[float]):
    """What is known of one frame besides its images; the conditions are those of `Conditions`.

    Attributes:
        world_from_tool: Pose of the robot's tool, shape (4, 4); the identity without a robot.
        normal_world: Unit normal of the target's plane n . x + d = 0, on the camera's side, (3,).
        offset: d of that plane, metres.
        target: `white`, `checkerboard` or another name.
        pose_id: Frames with the same id were taken without moving; None if unknown.
    """

    world_from_tool: np.ndarray
    normal_world: np.ndarray
    offset: float
    target: str
    pose_id: int | str | None = None


@dataclass(frozen=True, kw_only=True, eq=False)
class FrameTable(Conditions[np.ndarray]):
    """The rows of `frames.csv` as arrays, one entry per frame; units as in `FrameRow`.

    A condition has shape (N,). An optional column that the file lacks is None. An empty cell in an
    optional column is NaN (the empty text in `pose_id`): unknown, never zero.

    Attributes:
        world_from_tool: Shape (N, 4, 4), metres.
        normal_world: Shape (N, 3), exactly unit length.
        offset: Shape (N,), metres.
        target: Shape (N,), text.
        pose_id: Shape (N,), text, or None.
    """

    world_from_tool: np.ndarray
    normal_world: np.ndarray
    offset: np.ndarray
    target: np.ndarray
    pose_id: np.ndarray | None = None

    def __len__(self) -> int:
        """Return the number of frames."""
        return len(self.timestamp)

    def select(self, indices: Sequence[int] | np.ndarray) -> Self:
        """Return the table of these frames, in this order."""
        chosen = np.asarray(indices, dtype=np.int64)
        columns = {field.name: getattr(self, field.name) for field in fields(self)}
        present = {name: column for name, column in columns.items() if column is not None}
        return replace(self, **{name: column[chosen] for name, column in present.items()})

    def row(self, index: int) -> FrameRow:
        """Return one frame's row; an empty cell is None in it."""
        return FrameRow(
            timestamp=float(self.timestamp[index]),
            world_from_tool=self.world_from_tool[index],
            normal_world=self.normal_world[index],
            offset=float(self.offset[index]),
            target=str(self.target[index]),
            pose_id=None if self.pose_id is None else (str(self.pose_id[index]) or None),
            **{each.name: self._number(each.name, index) for each in OPTIONAL_CONDITIONS},
        )

    def rows(self) -> list[FrameRow]:
        """Return every frame's row."""
        return [self.row(index) for index in range(len(self))]

    def _number(self, attribute: str, index: int) -> float | None:
        column = getattr(self, attribute)
        return None if column is None or np.isnan(column[index]) else float(column[index])
