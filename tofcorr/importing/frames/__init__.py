"""Folders of depth images beside a file of robot poses."""

from pathlib import Path
from typing import Any

import click

from tofcorr.errors import ConfigError
from tofcorr.importing.checkerboard import import_boards
from tofcorr.importing.command_line import (
    coding_options,
    intrinsics_options,
    option,
    pose_format_option,
    posed_options,
    print_report,
    recording_out_option,
    take_coding,
    take_intrinsics,
    take_posed_options,
)

_DEPTH = "Names of the depth images (PNG, TIFF, NPY, EXR), such as 'depth/*.png'."
_AMPLITUDE = "Names of the amplitude or infrared images; * stands for the same as in --depth."
_GREY = "With --board: images that show it, 8 bits and colour allowed; left out: the amplitudes."
_POSES = "Poses of the tool in the base: a file, or a folder with a matrix a file."
_BOARD = "Instead of --poses: a board in each image; as in import checkerboard."
_TIMES = "List of 'time name' lines, where the images' names are no times."


@click.command(name="frames")
@click.argument("folder", type=click.Path(path_type=Path))
@recording_out_option
@option("--depth", _DEPTH, "depth_pattern", required=True)
@option("--amplitude", _AMPLITUDE, "amplitude_pattern")
@option("--grey", _GREY, "grey_pattern")
@option("--poses", _POSES, type=click.Path(path_type=Path))
@option("--board", _BOARD, metavar="BOARD")
@option("--square-mm", "With --board: side of a square or tag, mm.", type=float)
@pose_format_option
@option("--times", _TIMES, type=click.Path(path_type=Path))
@coding_options
@intrinsics_options
@posed_options
def command(folder: Path, out: Path, **given: Any) -> None:  # noqa: ANN401 - click's values
    """Import depth images in FOLDER and the robot poses they were taken from.

    With --poses no board is needed: walls, floor and tables are found in the depth, and their
    planes are estimated together with the calibration. Images are paired with poses by time stamp,
    by name or by order. With --board each image shows a board, and there is no robot. Images that
    cannot be used are left out, and import.json in the recording says why.
    """
    if (given["poses"] is None) == (given["board"] is None):
        ways = "--poses FILE (walls are then found), or --board and --square-mm"
        raise ConfigError(f"say where the planes come from, in one way: {ways}.")
    run = _from_poses if given["board"] is None else _from_boards
    print_report(run(folder, out, given), out)


def _from_poses(folder: Path, out: Path, given: dict[str, Any]) -> dict[str, Any]:
    """Import images of a moving robot."""
    from tofcorr.importing.frames.source import open_folder
    from tofcorr.importing.pose_files import read_poses
    from tofcorr.importing.posed import import_posed

    if given["grey_pattern"] is not None or given["square_mm"] is not None:
        raise ConfigError("--grey and --square-mm are for a board: name it with --board.")
    intrinsics, options = take_intrinsics(given), take_posed_options(given)
    if intrinsics is None:
        raise ConfigError("--calibrate needs a board: name it with --board, without --poses.")
    coding, track = take_coding(given), read_poses(given["poses"], given["pose_format"])
    more = {key: given[key] for key in ("amplitude_pattern", "times")}
    source = open_folder(folder, given["depth_pattern"], intrinsics, coding, track, **more)
    return import_posed(source, out, options)


def _from_boards(folder: Path, out: Path, given: dict[str, Any]) -> dict[str, Any]:
    """Import images of a board, without a robot."""
    given["infrared_pattern"] = given.pop("grey_pattern") or given["amplitude_pattern"]
    if given["infrared_pattern"] is None or given["square_mm"] is None:
        raise ConfigError("a board needs --square-mm, and --grey (or --amplitude) to find it in.")
    given["coding"] = take_coding(given)
    given["saturation_counts"] = given.pop("saturation_amplitude")
    given["modulation_frequency"] = given.pop("modulation_frequency_hz")
    return import_boards(folder, out, given)
