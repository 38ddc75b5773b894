"""From images of a board to a recording with known planes, by OpenCV.

`boards` finds the board's points, `pose` estimates the camera intrinsics and the pose of the board.
`importer` compares the depth with the pose, finds wrong units and mixed-up images, and reports
which quantities a board cannot separate.
"""

from pathlib import Path
from typing import Any

import click

from tofcorr.importing.command_line import (
    depth_kind_option,
    intrinsics_options,
    option,
    print_report,
    recording_out_option,
    take_intrinsics,
)


class BoardType(click.ParamType):
    """A board as COLUMNSxROWS, or with its kind in front; options of `CheckerboardOptions`."""

    name = "board"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:  # noqa: ANN401
        """Return the board, or refuse the text."""
        if not isinstance(value, str):
            return value
        from tofcorr.errors import ConfigError
        from tofcorr.importing.checkerboard.boards import read_board

        try:
            return read_board(value)
        except ConfigError as error:
            self.fail(str(error), param, ctx)


_BOARD = (
    "Inner corners (not squares), such as 5x7; or charuco:5x7:4X4_50:0.75 (squares, markers, their "
    "share of a square), or apriltag:6x6:APRILTAG_36H11:0.3 (tags, family, spacing)."
)
_FULL = "Infrared counts from which a pixel is saturated and not used."
_MARGIN = "How far the mask extends beyond the outermost inner corners; 1: edge of the squares."


@click.command(name="checkerboard")
@click.argument("folder", type=click.Path(path_type=Path))
@recording_out_option
@option("--depth", "Names of the depth images.", "depth_pattern", default="{view}_depth.png")
@option("--infrared", "Names of the infrared images.", "infrared_pattern", default="{view}_ir.png")
@option("--board", _BOARD, required=True, type=BoardType())
@option("--square-mm", "Side of a square or tag, mm.", required=True, type=float)
@option("--depth-unit-mm", "Millimetres per count; 0 counts mean no return.", default=1.0)
@depth_kind_option
@intrinsics_options
@option("--saturation", _FULL, "saturation_counts", default=65535.0)
@option("--margin-squares", _MARGIN, default=0.0)
@option("--max-reprojection-px", "Largest root mean square error of a view used.", default=0.5)
@option("--modulation-frequency-hz", "If known.", "modulation_frequency", type=float)
def command(folder: Path, out: Path, **given: Any) -> None:  # noqa: ANN401 - click's values
    """Import 16-bit PNG depth and infrared images of a checkerboard in FOLDER.

    The board's corners in the infrared image give the plane of each view; the measured depth is
    compared with it. Views that cannot be used are left out; import.json in the recording says why.
    """
    from tofcorr.importing.checkerboard.importer import CheckerboardOptions, import_checkerboard

    intrinsics = take_intrinsics(given)
    given |= given.pop("board")
    given["square_length"] = given.pop("square_mm") / 1000
    given["amplitude_pattern"] = given["infrared_pattern"]
    given["coding"] = {"unit_mm": given.pop("depth_unit_mm"), "invalid": ()}
    options = CheckerboardOptions.from_mapping(given, "tofcorr import checkerboard")
    print_report(import_checkerboard(folder, out, options, intrinsics), out)
