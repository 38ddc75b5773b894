"""The checkerboard."""

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True, kw_only=True)
class Board:
    """A flat checkerboard, described as OpenCV does.

    Attributes:
        columns: Inner corners (where four squares meet) in a row; at least 3.
        rows: Inner corners in a column; at least 3.
        square_length: Side of a square, metres.
    """

    columns: int
    rows: int
    square_length: float

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

    def __str__(self) -> str:
        """Name the board by its inner corners."""
        return f"{self.columns}x{self.rows}"
