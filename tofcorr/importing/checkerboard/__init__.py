"""From images of a board to a recording with known planes, by OpenCV.

`boards` finds the board's points, and estimates the camera intrinsics and the pose of the board.
`importer` compares the depth with the pose, finds wrong units and mixed-up images, and reports
which quantities a board cannot separate.
"""

from pathlib import Path
from typing import Any

import click

from tofcorr.importing.command_line import (
    command_name,
    depth_kind_option,
    intrinsics_options,
    option,
    print_report,
    recording_out_option,
    take_intrinsics,
)

_BOARD = (
    "Inner corners (not squares), such as 5x7; or charuco:5x7:4X4_50:0.75 (squares, markers, their "
    "share of a square), or apriltag:6x6:APRILTAG_36H11:0.3 (tags, family, spacing)."
)
_POSES = "Poses of the tool that carries the camera before a board that stands still."
_FULL = "Infrared counts from which a pixel is saturated and not used."
_MARGIN = "How far the mask extends beyond the outermost inner corners; 1: edge of the squares."


@click.command(name="checkerboard")
@click.argument("folder", type=click.Path(path_type=Path))
@recording_out_option
@option("--depth", "Names of the depth images.", "depth_pattern", default="{view}_depth.png")
@option("--infrared", "Names of the infrared images.", "infrared_pattern", default="{view}_ir.png")
@option("--board", _BOARD, required=True, metavar="BOARD")
@option("--square-mm", "Side of a square or tag, mm.", required=True, type=float)
@option("--depth-unit-mm", "Millimetres per count; 0 counts mean no return.", default=1.0)
@option("--poses", _POSES, type=click.Path(path_type=Path))
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
    given["amplitude_pattern"] = given["infrared_pattern"]
    given["coding"] = {"unit_mm": given.pop("depth_unit_mm"), "invalid": ()}
    print_report(import_boards(folder, out, given), out)


def import_boards(folder: Path, out: Path, given: dict[str, Any]) -> dict[str, Any]:
    """Import images of a board, by what click has read of the options of one of the commands.

    Raises:
        ConfigError: A value is not allowed.
    """
    from tofcorr.importing.checkerboard.boards import read_board
    from tofcorr.importing.checkerboard.importer import CheckerboardOptions, import_checkerboard

    intrinsics = take_intrinsics(given)
    given["board"] = read_board(given["board"]) | {"square_length": given["square_mm"] / 1000}
    own = {key: given[key] for key in CheckerboardOptions.model_fields if key in given}
    options = CheckerboardOptions.from_mapping(own, command_name())
    return import_checkerboard(folder, out, options, intrinsics)
