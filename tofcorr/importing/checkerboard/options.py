"""Options of the import of checkerboard images."""

from typing import Annotated, Literal

from pydantic import Field

from tofcorr.data.header import DepthKind
from tofcorr.importing.checkerboard.board import FlatBoard
from tofcorr.importing.checkerboard.board_kinds import BoardText
from tofcorr.options import Options

Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
CornerCount = Annotated[int, Field(ge=3)]


class CheckerboardOptions(Options):
    """How to read a folder of checkerboard images.

    Attributes:
        depth_pattern: Names of the depth images, with `{view}` or wildcards.
        infrared_pattern: Names of the infrared images.
        board_kind: One of `tofcorr.importing.checkerboard.board_kinds.BOARD_KINDS`.
        board_columns: Inner corners in a row; squares or tags of other kinds.
        board_rows: The same in a column.
        board_dictionary: Of the markers; None: the kind's usual one.
        board_share: Side of the markers, or space between tags, as a share of a side; None: the
            kind's usual one.
        square_length: Side of a square or tag, metres.
        depth_unit: Metres per count of the depth images; 0 counts mean no return.
        depth_kind: `z`: along the optical axis; `radial`: along the ray.
        saturation_counts: Infrared counts from which a pixel is saturated; None: never.
        margin_squares: How far the mask extends beyond the outermost inner corners, in squares. Up
            to 0 the corners surround every pixel used; 1 is the outer edge of the squares.
        max_reprojection_px: Views with a larger reprojection error (root mean square) are refused.
        modulation_frequency: Modulation frequency of the camera, Hz; None if unknown.
    """

    depth_pattern: str = "{view}_depth.png"
    infrared_pattern: str = "{view}_ir.png"
    board_kind: Literal["checkerboard", "charuco", "apriltag"] = "checkerboard"
    board_columns: CornerCount
    board_rows: CornerCount
    board_dictionary: str | None = None
    board_share: Annotated[float, Field(gt=0.0, lt=1.0)] | None = None
    square_length: Positive
    depth_unit: Positive = 1e-3
    depth_kind: DepthKind = "z"
    saturation_counts: Positive | None = 65535.0
    margin_squares: Annotated[float, Field(gt=-1.0, le=2.0)] = 0.0
    max_reprojection_px: Positive = 0.5
    modulation_frequency: Positive | None = None

    def board(self) -> FlatBoard:
        """Return the board."""
        return BoardText(
            self.board_kind,
            self.board_columns,
            self.board_rows,
            self.board_dictionary,
            self.board_share,
        ).board(self.square_length)
