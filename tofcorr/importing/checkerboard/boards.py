"""Flat boards of several kinds, and how their points are found in an image.

Active illumination falls with the square of the distance, so that counts span decades: every kind
of board is searched in several renderings of an image, and its points are refined on the counts.
"""

import re
from abc import ABC, abstractmethod
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any, ClassVar, Self

import cv2
import numpy as np

from tofcorr.errors import ConfigError

_FEWEST_CORNERS = 8
"""Fewer points of a board (no unit) do not place it: two tags, or a fifth of a small ChArUco board.
Set by hand."""

_SMALL_IMAGE_PIXELS = 1_000_000
"""Largest number of pixels of an image that is enlarged before the search: adaptive thresholds need
several pixels per square. Set by hand."""


@dataclass(frozen=True, kw_only=True)
class FlatBoard(ABC):
    """A flat board with points that can be found in an image.

    Attributes:
        columns: Inner corners, squares or tags in a row, as the kind counts them.
        rows: The same in a column.
        square_length: Side of a square or tag, metres: all points scale with it.
        dictionary: Of the markers, such as `4X4_50`; empty: the kind's usual one.
        share: Side of a marker (ChArUco) or space between tags (AprilTags) as a share of the side
            of a square or tag; 0: the kind's usual one.
    """

    kind: ClassVar[str]
    """What the recording calls the target."""
    called: ClassVar[str] = "{size}"
    """What messages call the board."""
    usual: ClassVar[tuple[str, float]] = ("", 0.0)
    """Dictionary and share of markers where none are given."""
    columns: int
    rows: int
    square_length: float
    dictionary: str = ""
    share: float = 0.0

    @abstractmethod
    def corner_points(self) -> np.ndarray:
        """Return the points in the board's frame, shape (N, 3), metres, in the plane z = 0."""

    @abstractmethod
    def find(self, image: np.ndarray) -> np.ndarray | None:
        """Find the points in an image (H, W) of any number type.

        Returns:
            Pixel coordinates (u, v), shape (N, 2), NaN for points that are hidden; None if the
            board is not seen.
        """

    def fewer(self) -> Self | None:
        """Return the board that a user means who counted squares instead of corners.

        None: the kind is described by its squares or tags.
        """
        return None

    def __str__(self) -> str:
        """Name the board."""
        size = f"{self.columns}x{self.rows}"
        return self.called.format(size=size, dictionary=self.dictionary or self.usual[0])

    def markers(self) -> tuple[cv2.aruco.Dictionary, float]:
        """Return the dictionary of the markers, and their share.

        Raises:
            ConfigError: There is no such dictionary.
        """
        known = {key.upper(): key for key in dir(cv2.aruco) if key.startswith("DICT_")}
        name = self.dictionary or self.usual[0]
        wanted = f"DICT_{name.upper().removeprefix('DICT_')}"
        if wanted not in known:
            listed = ", ".join(sorted(key.removeprefix("DICT_") for key in known))
            raise ConfigError(f"There is no dictionary of markers '{name}'. Known: {listed}.")
        found = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, known[wanted]))
        return found, self.square_length * (self.share or self.usual[1])


class Board(FlatBoard):
    """A checkerboard, described as OpenCV does: inner corners (where four squares meet)."""

    kind = "checkerboard"

    def corner_points(self) -> np.ndarray:
        """Return the inner corners in the board's frame, row by row, shape (N, 3), metres.

        The first corner is the origin, x runs along a row, and the board is the plane z = 0.
        """
        row, column = np.divmod(np.arange(self.rows * self.columns), self.columns)
        return np.stack([column, row, np.zeros_like(row)], axis=1) * self.square_length

    def find(self, image: np.ndarray) -> np.ndarray | None:
        """Find the corners in an image; all of them or none.

        OpenCV's classic detector comes first, then its slower sector-based one. The order is that
        of `corner_points` up to a symmetry of the board, which changes neither plane nor outline.
        """
        size = (self.columns, self.rows)
        classic = cv2.CALIB_CB_ADAPTIVE_THRESH | cv2.CALIB_CB_NORMALIZE_IMAGE
        classic |= cv2.CALIB_CB_FAST_CHECK
        for search, flags in (
            (cv2.findChessboardCorners, classic),
            (cv2.findChessboardCornersSB, cv2.CALIB_CB_NORMALIZE_IMAGE),
        ):
            for rendering, scale in _renderings(image):
                found, corners = search(rendering, size, flags=flags)
                if found:
                    return self._refined(image, _unscaled(corners, scale))
        return None

    def fewer(self) -> Self | None:
        """Return the board of one row and column fewer; OpenCV refuses fewer than 3 corners."""
        if min(self.columns, self.rows) <= 3:
            return None
        return replace(self, columns=self.columns - 1, rows=self.rows - 1)

    def _refined(self, image: np.ndarray, corners: np.ndarray) -> np.ndarray:
        """Refine corners on the logarithm of the counts around the board.

        With the logarithm an edge between dark and bright squares looks the same near and far.
        """
        grid = corners.reshape(self.rows, self.columns, 2)
        steps = [np.linalg.norm(np.diff(grid, axis=axis), axis=-1).min() for axis in (0, 1)]
        spacing = float(min(steps))
        low = np.maximum(np.floor(corners.min(axis=0) - spacing), 0).astype(int)
        high = np.ceil(corners.max(axis=0) + spacing).astype(int) + 1
        patch = np.log1p(image[low[1] : high[1], low[0] : high[0]].astype(np.float32))
        # The window must not contain the next corner. Set on 102 real views: 0.4 had the smallest
        # reprojection error and lost no corner.
        return _to_subpixels(patch, corners - low, 2 * spacing / 5) + low


class CharucoBoard(FlatBoard):
    """A ChArUco board: a checkerboard whose white squares carry markers, found even in part."""

    kind = "charuco"
    called = "ChArUco {size} ({dictionary})"
    usual = ("4X4_50", 0.75)

    def corner_points(self) -> np.ndarray:
        """Return the inner corners, row by row, shape (N, 3), metres."""
        return np.asarray(self._board().getChessboardCorners(), dtype=np.float64)

    def find(self, image: np.ndarray) -> np.ndarray | None:
        """Find the corners in an image; in the rendering that shows most of them."""
        detector = cv2.aruco.CharucoDetector(self._board())
        best = np.full(((self.columns - 1) * (self.rows - 1), 2), np.nan)
        most = _FEWEST_CORNERS - 1
        for rendering, scale in _renderings(image):
            corners, numbers, _, _ = detector.detectBoard(rendering)
            if numbers is not None and len(numbers) > most:
                most, best[:] = len(numbers), np.nan
                best[np.ravel(numbers).astype(int)] = _unscaled(corners, scale)
            if most == len(best):
                break
        return best if most >= _FEWEST_CORNERS else None

    def _board(self) -> cv2.aruco.CharucoBoard:
        dictionary, side = self.markers()
        size = (self.columns, self.rows)
        return cv2.aruco.CharucoBoard(size, self.square_length, side, dictionary)


class AprilGrid(FlatBoard):
    """A grid of AprilTags, numbered row by row from zero, found even in part.

    The side of a tag is its black border's.
    """

    kind = "apriltag"
    called = "{size} tags ({dictionary})"
    usual = ("APRILTAG_36H11", 0.3)

    def corner_points(self) -> np.ndarray:
        """Return the corners of the tags, tag by tag, shape (N, 3), metres."""
        dictionary, space = self.markers()
        size = (self.columns, self.rows)
        grid = cv2.aruco.GridBoard(size, self.square_length, space, dictionary)
        return np.concatenate(grid.getObjPoints()).astype(np.float64)

    def find(self, image: np.ndarray) -> np.ndarray | None:
        """Find the tags in all renderings of an image, and refine their corners on its counts."""
        detector = cv2.aruco.ArucoDetector(self.markers()[0])
        found = np.full((self.columns * self.rows, 4, 2), np.nan)
        for rendering, scale in _renderings(image):
            corners, numbers, _ = detector.detectMarkers(rendering)
            tags = () if numbers is None else np.ravel(numbers).astype(int).tolist()
            for four, number in zip(corners, tags, strict=True):
                if number < len(found) and np.isnan(found[number]).any():
                    found[number] = _unscaled(four, scale)
            if np.isfinite(found).all():
                break
        seen = np.isfinite(found).all(axis=(1, 2))
        if 4 * seen.sum() < _FEWEST_CORNERS:
            return None
        tags = found[seen]
        sides = np.linalg.norm(tags - np.roll(tags, 1, axis=1), axis=2)
        # On counts: their logarithm would shrink dark tags. A bit of a tag measures an eighth of
        # its side, and the window must not contain the next edge.
        refined = _to_subpixels(image.astype(np.float32), tags.reshape(-1, 2), sides.min() / 10)
        found[seen] = refined.reshape(tags.shape)
        return found.reshape(-1, 2)


BOARDS = {board.kind: board for board in (Board, CharucoBoard, AprilGrid)}
"""The kinds of boards."""


def read_board(text: str) -> dict[str, Any]:
    """Read `5x7`, `charuco:5x7:4X4_50:0.75` or `apriltag:6x6:APRILTAG_36H11:0.3`.

    That is `KIND:COLUMNSxROWS:DICTIONARY:SHARE`, of which the last two may be missing, or
    `COLUMNSxROWS` of a checkerboard.

    Returns:
        The options of `CheckerboardOptions` that describe the board; None: the kind's usual value.

    Raises:
        ConfigError: The text is something else.
    """
    number, word = r"(\d+)", "(?::([^:]+))?"
    match = re.fullmatch(f"(?:({'|'.join(BOARDS)}):)?{number}[xX]{number}{word}{word}", text)
    if match is None or (match[1] in (None, Board.kind) and match[4] is not None):
        raise ConfigError(f"expected 5x7, charuco:5x7:4X4_50:0.75 or the like, got '{text[:60]}'.")
    keys = ("board_kind", "board_columns", "board_rows", "board_dictionary", "board_share")
    return dict(zip(keys, (match[1] or Board.kind, *match.groups()[1:]), strict=True))


def _renderings(infrared: np.ndarray) -> Iterator[tuple[np.ndarray, int]]:
    """Yield 8-bit images with their enlargement, the most promising first."""
    counts = infrared.astype(np.float32)
    logarithmic = _eight_bit(np.log1p(counts), 99.9)
    contrasts = (
        cv2.createCLAHE(clipLimit=3.0, tileGridSize=(8, 8)).apply(logarithmic),
        _eight_bit(counts, 99),
        logarithmic,
    )
    for scale in (2, 1) if infrared.size <= _SMALL_IMAGE_PIXELS else (1, 2):
        for contrast in contrasts:
            yield _enlarged(contrast, scale), scale


def _eight_bit(values: np.ndarray, high_percentile: float) -> np.ndarray:
    low, high = np.percentile(values, [1, high_percentile])
    stretched = (values - low) * (255 / max(high - low, np.finfo(np.float32).eps))
    return np.clip(stretched, 0, 255).astype(np.uint8)


def _enlarged(image: np.ndarray, scale: int) -> np.ndarray:
    return cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_CUBIC)


def _to_subpixels(image: np.ndarray, corners: np.ndarray, half_window: float) -> np.ndarray:
    """Refine corners (N, 2) on an image of floats, within a window (half its side, pixels)."""
    window, scale = 2 * (max(2, round(2 * half_window)),), 2
    # Pixel centres are at integers, so enlarging shifts the origin by half a pixel.
    there = ((corners + 0.5) * scale - 0.5).astype(np.float32)
    stop = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 100, 1e-4)
    larger = _enlarged(image, scale)
    refined = cv2.cornerSubPix(larger, np.ascontiguousarray(there), window, (-1, -1), stop)
    return _unscaled(refined, scale)


def _unscaled(pixels: np.ndarray, scale: int) -> np.ndarray:
    """Return pixels (N, 2) of an enlarged image as pixels of the image itself."""
    return (pixels.reshape(-1, 2).astype(np.float64) + 0.5) / scale - 0.5
