"""`tofcorr import frames`: parse, import, print."""

from pathlib import Path
from typing import Any

import click

from tofcorr.importing.command_line import (
    coding_options,
    intrinsics_options,
    print_report,
    progress_bar,
    take_coding,
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
@coding_options
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
    from tofcorr.importing.posed.drive import Drive
    from tofcorr.importing.posed.source import import_posed
    from tofcorr.importing.poses.read import read_poses

    intrinsics = take_intrinsics(given)
    if intrinsics is None:
        raise ConfigError("--calibrate needs a board: use tofcorr import checkerboard.")
    options = take_posed_options(given, _WHERE)
    coding = take_coding(given, _WHERE)
    track = read_poses(given["poses"], given["pose_format"])
    source = open_folder(
        folder,
        given["depth_pattern"],
        intrinsics,
        coding,
        amplitude_pattern=given["amplitude_pattern"],
        times=given["times"],
    )
    drive = Drive(source=source, track=track, refused=source.refused)
    report = import_posed(drive, out, options, progress_bar)
    print_report(report, out)
