"""From images of a board to a recording with known planes, by OpenCV.

`boards` finds the board's points, `pose` estimates the camera intrinsics and the pose of the board.
`checks` compares the depth with the pose, finds wrong units and mixed-up images, and reports which
quantities a board cannot separate. `importer` does this for a folder.
"""

from pathlib import Path
from typing import Any

import click

from tofcorr.files import NewPath
from tofcorr.importing.command_line import (
    depth_kind_option,
    intrinsics_options,
    print_report,
    progress_bar,
    shown_option,
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


@click.command(name="checkerboard")
@click.argument("folder", type=click.Path(path_type=Path))
@click.option("--out", required=True, type=NewPath(), help="Recording to write.")
@shown_option(
    "--depth",
    "{view}_depth.png",
    "Names of the depth images; {view} (or *) is what a pair of images shares.",
    "depth_pattern",
)
@shown_option("--infrared", "{view}_ir.png", "Names of the infrared images.", "infrared_pattern")
@click.option(
    "--board",
    required=True,
    type=BoardType(),
    help="Inner corners (not squares), such as 5x7; or charuco:5x7:4X4_50:0.75 (squares, markers, "
    "their share of a square), or apriltag:6x6:APRILTAG_36H11:0.3 (tags, family, spacing).",
)
@click.option("--square-mm", required=True, type=float, help="Side of a square or tag, mm.")
@shown_option(
    "--depth-unit-mm", 1.0, "Millimetres per count of the depth images; 0 counts mean no return."
)
@depth_kind_option
@intrinsics_options
@shown_option(
    "--saturation",
    65535.0,
    "Pixels at or above this many infrared counts are saturated and not used.",
    "saturation_counts",
)
@shown_option(
    "--margin-squares",
    0.0,
    "How far the mask extends beyond the outermost inner corners; 1: edge of the squares.",
)
@shown_option(
    "--max-reprojection-px",
    0.5,
    "Views with a larger reprojection error (root mean square) are refused.",
)
@click.option("--modulation-frequency-hz", "modulation_frequency", type=float, help="If known.")
def command(folder: Path, out: Path, **given: Any) -> None:  # noqa: ANN401 - click's values
    """Import 16-bit PNG depth and infrared images of a checkerboard in FOLDER.

    The board's corners in the infrared image give the plane of each view; the measured depth is
    compared with it. Views that cannot be used are left out; import.json in the recording says why.
    """
    from tofcorr.importing.checkerboard.importer import CheckerboardOptions, import_checkerboard

    intrinsics = take_intrinsics(given)
    given |= given.pop("board")
    given["square_length"] = given.pop("square_mm") * 1e-3
    given["depth_unit"] = given.pop("depth_unit_mm") * 1e-3
    options = CheckerboardOptions.from_mapping(given, "tofcorr import checkerboard")
    print_report(import_checkerboard(folder, out, options, intrinsics, progress_bar), out)
