"""Single-pixel and few-zone sensors: rows of distances beside robot poses."""

from pathlib import Path
from typing import Any

import click

from tofcorr.files import NewPath
from tofcorr.importing.command_line import (
    NumberList,
    pose_format_option,
    posed_options,
    print_report,
    progress_bar,
    take_posed_options,
)


@click.command(name="distances")
@click.argument("sources", type=click.Path(path_type=Path), nargs=-1, required=True)
@click.option("--out", required=True, type=NewPath(), help="Recording to write.")
@click.option(
    "--poses",
    type=click.Path(path_type=Path),
    multiple=True,
    help="Poses beside each file of distances, in the order of the sources.",
)
@pose_format_option
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
    from tofcorr.importing.distances.readings import open_distances, sensor_camera, zones_of
    from tofcorr.importing.posed import import_posed

    zones = zones_of(given.pop("zones"))
    if zones == (1, 1):
        # Along the one ray both kinds are the same.
        given["depth_kind"] = "radial"
    options = take_posed_options(given)
    camera = sensor_camera(zones, given.pop("fov_deg"))
    report = import_posed(open_distances(sources, camera, **given), out, options, progress_bar)
    print_report(report, out)
