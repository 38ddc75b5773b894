"""Single-pixel and few-zone sensors: rows of distances beside robot poses."""

from pathlib import Path
from typing import Any

import click

from tofcorr.importing.command_line import (
    number_list,
    option,
    pose_format_option,
    posed_options,
    print_report,
    recording_out_option,
    take_posed_options,
)

_POSES = "Poses beside each file of distances, in the order of the sources."
_COUNTS = "Millimetres per count; left out: 1 for numbers typically above 20, else 1000."


@click.command(name="distances")
@click.argument("sources", type=click.Path(path_type=Path), nargs=-1, required=True)
@recording_out_option
@option("--poses", _POSES, type=click.Path(path_type=Path), multiple=True)
@pose_format_option
@option("--wall", "Name of each wall; left out: the source's.", "names", multiple=True)
@option("--zones", "COLUMNSxROWS of the sensor.", default="1x1")
@option("--fov-deg", "Field of view of all zones, degrees: H,V.", type=number_list(1, 2))
@option("--depth-unit-mm", _COUNTS, "unit_mm", type=float)
@posed_options
def command(sources: tuple[Path, ...], out: Path, **given: Any) -> None:  # noqa: ANN401
    """Import the distances of a single-pixel or few-zone sensor before flat walls.

    Each of SOURCES is one wall: a file with a row of distances for each pose and --poses beside it,
    or a folder that holds measurements.csv and transforms.csv. Several readings at one pose stand
    in one row; their median is used.
    """
    from tofcorr.importing.distances.readings import open_distances, sensor_lens, zones_of
    from tofcorr.importing.posed import import_posed

    zones = zones_of(given.pop("zones"))
    if zones == (1, 1):
        # Along the one ray both kinds are the same.
        given["depth_kind"] = "radial"
    options = take_posed_options(given)
    lens = sensor_lens(zones, given.pop("fov_deg"))
    images = open_distances(sources, zones, lens, **given)
    print_report(import_posed(images, out, options), out)
