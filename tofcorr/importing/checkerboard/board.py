"""The checkerboard, and what a board of any kind must be able to do."""

from abc import ABC, abstractmethod
from dataclasses import dataclass, replace
from typing import ClassVar, Self

import numpy as np

from tofcorr.importing.checkerboard.detection import find_corners

# No smaller board is tried than of so many inner corners a side: OpenCV's detector refuses fewer.
_FEWEST_COLUMNS = 3


@dataclass(frozen=True, kw_only=True)
class FlatBoard(ABC):
    """A flat board with points that can be found in an image.

    Attributes:
        kind: What the recording calls the target.
        columns: Inner corners, squares or tags in a row, as the kind counts them.
        rows: The same in a column.
        square_length: Side of a square or tag, metres: all points scale with it.
    """

    kind: ClassVar[str]
    columns: int
    rows: int
    square_length: float

    @property
    @abstractmethod
    def num_corners(self) -> int:
        """Number of points."""

    @abstractmethod
    def corner_points(self) -> np.ndarray:
        """Return the points in the board's frame, shape (N, 3), metres, in the plane z = 0."""

    @abstractmethod
    def outline(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the smallest and largest x and y of the points, in squares, each (2,)."""

    @abstractmethod
    def find(self, image: np.ndarray) -> np.ndarray | None:
        """Find the points in an image (H, W) of any number type.

        Returns:
            Pixel coordinates (u, v), shape (N, 2), NaN for points that are hidden; None if the
            board is not seen.
        """

    def scaled(self, factor: float) -> Self:
        """Return the board enlarged by a factor."""
        return replace(self, square_length=self.square_length * factor)

    def fewer(self) -> Self | None:
        """Return the board that a user means who counted squares instead of corners.

        None: the kind is described by its squares or tags.
        """
        return None


@dataclass(frozen=True, kw_only=True)
class Board(FlatBoard):
    """A flat checkerboard, described as OpenCV does.

    Attributes:
        columns: Inner corners (where four squares meet) in a row; at least 3.
        rows: Inner corners in a column; at least 3.
        square_length: Side of a square, metres.
    """

    kind: ClassVar[str] = "checkerboard"

    @property
    def num_corners(self) -> int:
        """Number of inner corners."""
        return self.columns * self.rows

    def corner_points(self) -> np.ndarray:
        """Return the inner corners in the board's frame, row by row, shape (N, 3), metres.

        The first corner is the origin, x runs along a row, and the board is the plane z = 0.
        """
        grid = np.zeros((self.rows, self.columns, 3))
        grid[..., 0] = np.arange(self.columns)
        grid[..., 1] = np.arange(self.rows)[:, None]
        return grid.reshape(-1, 3) * self.square_length

    def outline(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the smallest and largest x and y of the corners, in squares."""
        return np.zeros(2), np.array([self.columns - 1.0, self.rows - 1.0])

    def find(self, image: np.ndarray) -> np.ndarray | None:
        """Find the corners in an image; all of them or none."""
        return find_corners(image, self)

    def fewer(self) -> Self | None:
        """Return the board of one row and column fewer."""
        if min(self.columns, self.rows) <= _FEWEST_COLUMNS:
            return None
        return replace(self, columns=self.columns - 1, rows=self.rows - 1)

    def __str__(self) -> str:
        """Name the board by its inner corners."""
        return f"{self.columns}x{self.rows}"
