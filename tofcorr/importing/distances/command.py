"""`tofcorr import distances`: parse, import, print."""

from pathlib import Path
from typing import Any

import click

from tofcorr.files.arguments import NewPath
from tofcorr.importing.command_line import NumberList, print_report, progress_bar
from tofcorr.importing.posed.command_line import posed_options, take_posed_options

_WHERE = "tofcorr import distances"


@click.command(name="distances")
@click.argument("sources", type=click.Path(path_type=Path), nargs=-1, required=True)
@click.option("--out", required=True, type=NewPath(), help="Recording to write.")
@click.option(
    "--poses",
    type=click.Path(path_type=Path),
    multiple=True,
    help="Poses beside each file of distances, in the order of the sources.",
)
@click.option(
    "--pose-format",
    type=click.Choice(["tum", "csv", "matrix", "matrices", "moveit"]),
    help="Left out: told from the file.",
)
@click.option("--wall", "walls", multiple=True, help="Name of each wall; left out: the source's.")
@click.option("--zones", default="1x1", show_default=True, help="COLUMNSxROWS of the sensor.")
@click.option("--fov-deg", type=NumberList(1, 2), help="Field of view of all zones, degrees: H,V.")
@click.option(
    "--depth-unit-mm",
    "unit_mm",
    type=float,
    help="Millimetres per count; left out: 1 for numbers typically above 20, else 1000.",
)
@posed_options
def command(sources: tuple[Path, ...], out: Path, **given: Any) -> None:  # noqa: ANN401
    """Import the distances of a single-pixel or few-zone sensor before flat walls.

    Each of SOURCES is one wall: a file with a row of distances for each pose and --poses beside it,
    or a folder that holds measurements.csv and transforms.csv. Several readings at one pose stand
    in one row; their median is used.
    """
    from tofcorr.importing.distances.sensor import sensor_camera, zones_of
    from tofcorr.importing.distances.source import open_distances
    from tofcorr.importing.posed.drive import Drive
    from tofcorr.importing.posed.source import import_posed

    zones = zones_of(given.pop("zones"))
    if zones == (1, 1):
        # Along the one ray both kinds are the same.
        given["depth_kind"] = "radial"
    options = take_posed_options(given, _WHERE)
    source = open_distances(
        sources,
        sensor_camera(zones, given["fov_deg"]),
        poses=given["poses"],
        pose_format=given["pose_format"],
        walls=given["walls"],
        unit_mm=given["unit_mm"],
    )
    drive = Drive(
        source=source, track=source.track, warnings=source.warnings, targets=source.targets
    )
    report = import_posed(drive, out, options, progress_bar)
    print_report(report, out)
