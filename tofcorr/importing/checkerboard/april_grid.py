"""Grids of AprilTags: the corners of tags, found even in part."""

from dataclasses import dataclass
from typing import ClassVar

import cv2
import numpy as np

from tofcorr.importing.checkerboard.board import FlatBoard
from tofcorr.importing.checkerboard.detection import (
    REFINEMENT_SCALE,
    REFINEMENT_STOP,
    enlarged,
    renderings,
    scaled,
    unscaled,
)
from tofcorr.importing.checkerboard.markers import FEWEST_CORNERS, marker_dictionary

_REFINEMENT_WINDOW = 0.1
"""Half the refinement window in sides of a tag: a bit of a tag measures an eighth, and the window
must not contain the next edge."""


@dataclass(frozen=True, kw_only=True)
class AprilGrid(FlatBoard):
    """A grid of AprilTags, numbered row by row from zero.

    Attributes:
        columns: Tags in a row.
        rows: Tags in a column.
        square_length: Side of a tag (its black border), metres.
        spacing_share: Space between tags as a share of a tag's side.
        dictionary: The family, such as `APRILTAG_36H11`.
    """

    kind: ClassVar[str] = "apriltag"
    spacing_share: float = 0.3
    dictionary: str = "APRILTAG_36H11"

    @property
    def num_corners(self) -> int:
        """Number of corners of tags."""
        return 4 * self.columns * self.rows

    def corner_points(self) -> np.ndarray:
        """Return the corners of the tags, tag by tag, shape (N, 3), metres."""
        return np.concatenate(self._board().getObjPoints()).astype(np.float64)

    def outline(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the smallest and largest x and y of the corners, in sides of a tag."""
        tags = np.array([self.columns, self.rows], dtype=np.float64)
        return np.zeros(2), tags + (tags - 1) * self.spacing_share

    def find(self, image: np.ndarray) -> np.ndarray | None:
        """Find the tags in all renderings of an image, and refine their corners on its counts."""
        detector = cv2.aruco.ArucoDetector(marker_dictionary(self.dictionary))
        found = np.full((self.num_corners // 4, 4, 2), np.nan)
        for rendering, scale in renderings(image):
            corners, numbers, _ = detector.detectMarkers(rendering)
            tags = [] if numbers is None else [int(number) for number in np.ravel(numbers)]
            for four, number in zip(corners, tags, strict=True):
                if number < len(found) and np.isnan(found[number]).any():
                    found[number] = unscaled(four, scale)
            if np.isfinite(found).all():
                break
        seen = np.isfinite(found).all(axis=(1, 2))
        if 4 * seen.sum() < FEWEST_CORNERS:
            return None
        found[seen] = _refined(image, found[seen])
        return found.reshape(-1, 2)

    def __str__(self) -> str:
        """Name the board."""
        return f"{self.columns}x{self.rows} tags ({self.dictionary})"

    def _board(self) -> cv2.aruco.GridBoard:
        return cv2.aruco.GridBoard(
            (self.columns, self.rows),
            self.square_length,
            self.square_length * self.spacing_share,
            marker_dictionary(self.dictionary),
        )


def _refined(image: np.ndarray, tags: np.ndarray) -> np.ndarray:
    """Refine corners of tags (T, 4, 2) on counts: their logarithm would shrink dark tags."""
    sides = np.linalg.norm(tags - np.roll(tags, 1, axis=1), axis=2)
    window = max(2, round(_REFINEMENT_WINDOW * float(sides.min()) * REFINEMENT_SCALE))
    flat = np.ascontiguousarray(scaled(tags.reshape(-1, 2), REFINEMENT_SCALE), np.float32)
    refined = cv2.cornerSubPix(
        enlarged(image.astype(np.float32), REFINEMENT_SCALE),
        flat,
        (window, window),
        (-1, -1),
        REFINEMENT_STOP,
    )
    return unscaled(refined, REFINEMENT_SCALE).reshape(tags.shape)
