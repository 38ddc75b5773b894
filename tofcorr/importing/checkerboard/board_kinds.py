"""The kinds of boards: one line a kind."""

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

from tofcorr.errors import ConfigError
from tofcorr.importing.checkerboard.april_grid import AprilGrid
from tofcorr.importing.checkerboard.board import Board, FlatBoard
from tofcorr.importing.checkerboard.charuco import CharucoBoard


class BoardText(NamedTuple):
    """A board as it is written: `KIND:COLUMNSxROWS:DICTIONARY:SHARE`, or `COLUMNSxROWS` alone.

    Attributes:
        kind: One of `BOARD_KINDS`.
        columns: Inner corners, squares or tags in a row.
        rows: The same in a column.
        dictionary: Of the markers; None: the kind's usual one.
        share: Of the markers' side (ChArUco) or spacing (AprilTags); None: the kind's usual one.
    """

    kind: str
    columns: int
    rows: int
    dictionary: str | None = None
    share: float | None = None

    def board(self, square_length: float) -> FlatBoard:
        """Return the board whose squares or tags have sides of `square_length` metres."""
        return BOARD_KINDS[self.kind](self, square_length)


def _checkerboard(text: BoardText, square_length: float) -> FlatBoard:
    return Board(columns=text.columns, rows=text.rows, square_length=square_length)


def _charuco(text: BoardText, square_length: float) -> FlatBoard:
    return CharucoBoard(
        columns=text.columns,
        rows=text.rows,
        square_length=square_length,
        **_given(marker_share=text.share, dictionary=text.dictionary),
    )


def _april_grid(text: BoardText, square_length: float) -> FlatBoard:
    return AprilGrid(
        columns=text.columns,
        rows=text.rows,
        square_length=square_length,
        **_given(spacing_share=text.share, dictionary=text.dictionary),
    )


def _given(**values: Any) -> dict[str, Any]:  # noqa: ANN401 - of the boards' own types
    """Return what the text says; the board's class has the usual values of the rest."""
    return {name: value for name, value in values.items() if value}


BOARD_KINDS: Mapping[str, Callable[[BoardText, float], FlatBoard]] = {
    "checkerboard": _checkerboard,
    "charuco": _charuco,
    "apriltag": _april_grid,
}
"""How a board of each kind is made."""


def read_board(text: str) -> BoardText:
    """Read `5x7`, `charuco:5x7:4X4_50:0.75` or `apriltag:6x6:APRILTAG_36H11:0.3`.

    Raises:
        ConfigError: The text is something else.
    """
    kind, *rest = text.split(":") if ":" in text else ("checkerboard", text)
    size = rest[0].lower().split("x")
    shaped = len(size) == 2 and all(part.isdecimal() and int(part) > 0 for part in size)
    if kind not in BOARD_KINDS or not shaped or len(rest) > (1 if kind == "checkerboard" else 3):
        raise ConfigError(
            f"expected inner corners such as 5x7, or charuco:5x7:4X4_50:0.75 or "
            f"apriltag:6x6:APRILTAG_36H11:0.3, got '{text[:60]}'."
        )
    share = None
    if len(rest) == 3:
        try:
            share = float(rest[2])
        except ValueError:
            share = 0.0
        if not 0 < share < 1:
            raise ConfigError(f"the share in '{text[:60]}' must be between 0 and 1.")
    return BoardText(kind, int(size[0]), int(size[1]), rest[1] if len(rest) > 1 else None, share)
