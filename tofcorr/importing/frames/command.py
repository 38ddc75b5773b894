"""`tofcorr import frames`: parse, import, print."""

from pathlib import Path
from typing import Any

import click

from tofcorr.importing.command_line import (
    NumberList,
    intrinsics_options,
    print_report,
    progress_bar,
    take_intrinsics,
)
from tofcorr.importing.posed.command_line import posed_options, take_posed_options

_WHERE = "tofcorr import frames"


@click.command(name="frames")
@click.argument("folder", type=click.Path(path_type=Path))
@click.option("--out", required=True, type=click.Path(path_type=Path), help="Recording to write.")
@click.option(
    "--depth",
    "depth_pattern",
    required=True,
    help="Names of the depth images (PNG, TIFF, NPY, EXR), such as 'depth/*.png'.",
)
@click.option(
    "--amplitude",
    "amplitude_pattern",
    help="Names of the amplitude or infrared images; * stands for the same as in --depth.",
)
@click.option(
    "--poses",
    required=True,
    type=click.Path(path_type=Path),
    help="Poses of the tool in the base: a file, or a folder with a matrix a file.",
)
@click.option(
    "--pose-format",
    type=click.Choice(["tum", "csv", "matrix", "matrices", "moveit"]),
    help="Left out: told from the file.",
)
@click.option(
    "--times",
    type=click.Path(path_type=Path),
    help="List of 'time name' lines, where the images' names are no times.",
)
@click.option(
    "--depth-unit-mm",
    "unit_mm",
    type=float,
    help="Millimetres per count; left out: 1 for whole numbers, 1000 (metres) for floats.",
)
@click.option(
    "--invalid",
    type=NumberList(*range(1, 9)),
    default="0,65535",
    show_default=True,
    help="Numbers that mean 'no return', besides NaN.",
)
@click.option("--big-endian", is_flag=True, help="The two bytes of each number are swapped.")
@click.option(
    "--rotate",
    type=click.Choice(["0", "90", "180", "270"]),
    default="0",
    show_default=True,
    help="Degrees clockwise by which images are turned to fit the intrinsics.",
)
@intrinsics_options
@posed_options
def command(folder: Path, out: Path, **given: Any) -> None:  # noqa: ANN401 - click's values
    """Import depth images in FOLDER and the robot poses they were taken from.

    No board is needed: walls, floor and tables are found in the depth, and their planes are
    estimated together with the calibration. Images are paired with poses by time stamp, by name or
    by order; those that cannot be used are left out, and import.json in the recording says why.
    """
    from tofcorr.errors import ConfigError
    from tofcorr.importing.frames.source import open_folder
    from tofcorr.importing.images.coding import DepthCoding
    from tofcorr.importing.posed.source import import_posed
    from tofcorr.importing.poses.read import read_poses

    intrinsics = take_intrinsics(given)
    if intrinsics is None:
        raise ConfigError("--calibrate needs a board: use tofcorr import checkerboard.")
    options = take_posed_options(given, _WHERE)
    coding = DepthCoding.from_mapping(
        {
            "unit_mm": given["unit_mm"],
            "invalid": given["invalid"],
            "big_endian": given["big_endian"],
            "rotate": int(given["rotate"]),
        },
        _WHERE,
    )
    track = read_poses(given["poses"], given["pose_format"])
    source = open_folder(
        folder,
        given["depth_pattern"],
        intrinsics,
        coding,
        amplitude_pattern=given["amplitude_pattern"],
        times=given["times"],
    )
    report = import_posed(
        source, track, out, options, refused=source.refused, progress=progress_bar
    )
    print_report(report, out)
