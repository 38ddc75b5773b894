"""ChArUco boards: a checkerboard whose white squares carry markers, found even in part."""

from dataclasses import dataclass
from typing import ClassVar

import cv2
import numpy as np

from tofcorr.importing.checkerboard.board import FlatBoard
from tofcorr.importing.checkerboard.detection import renderings, unscaled
from tofcorr.importing.checkerboard.markers import FEWEST_CORNERS, marker_dictionary


@dataclass(frozen=True, kw_only=True)
class CharucoBoard(FlatBoard):
    """A ChArUco board, described as OpenCV does.

    Attributes:
        columns: Squares in a row.
        rows: Squares in a column.
        square_length: Side of a square, metres.
        marker_share: Side of a marker as a share of the square's.
        dictionary: Of the markers, such as `4X4_50`.
    """

    kind: ClassVar[str] = "charuco"
    marker_share: float = 0.75
    dictionary: str = "4X4_50"

    @property
    def num_corners(self) -> int:
        """Number of inner corners."""
        return (self.columns - 1) * (self.rows - 1)

    def corner_points(self) -> np.ndarray:
        """Return the inner corners, row by row, shape (N, 3), metres."""
        return np.asarray(self._board().getChessboardCorners(), dtype=np.float64)

    def outline(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the smallest and largest x and y of the corners, in squares."""
        return np.ones(2), np.array([self.columns - 1.0, self.rows - 1.0])

    def find(self, image: np.ndarray) -> np.ndarray | None:
        """Find the corners in an image; in the rendering that shows most of them."""
        detector = cv2.aruco.CharucoDetector(self._board())
        best: np.ndarray | None = None
        most = FEWEST_CORNERS - 1
        for rendering, scale in renderings(image):
            corners, numbers, _, _ = detector.detectBoard(rendering)
            if numbers is None or len(numbers) <= most:
                continue
            most = len(numbers)
            best = np.full((self.num_corners, 2), np.nan)
            best[np.ravel(numbers).astype(np.int64)] = unscaled(corners, scale)
            if most == self.num_corners:
                break
        return best

    def __str__(self) -> str:
        """Name the board."""
        return f"ChArUco {self.columns}x{self.rows} ({self.dictionary})"

    def _board(self) -> cv2.aruco.CharucoBoard:
        return cv2.aruco.CharucoBoard(
            (self.columns, self.rows),
            self.square_length,
            self.square_length * self.marker_share,
            marker_dictionary(self.dictionary),
        )
