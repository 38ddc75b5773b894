"""Single-pixel and few-zone sensors: rows of distances beside robot poses."""

from pathlib import Path
from typing import Any

import click

from tofcorr.importing.command_line import (
    invalid_option,
    number_list,
    option,
    pose_format_option,
    posed_options,
    print_report,
    recording_out_option,
    rotate_option,
    take_posed_options,
)

_POSES = "Poses beside each file of distances, in the order of the sources."
_COUNTS = "Millimetres per count; left out: 1 for numbers typically above 20, else 1000."
_WALL = "Name of each source's wall; several may share one. Left out: the source's."
_PLANE = "Measured plane of each source's wall, in the base: NX,NY,NZ,D of n.x + d = 0, metres."
_ORDER = "How the table lists zones: row by row, or column by column."
_FLIPS = ["none", "horizontal", "vertical", "both"]
_FLIP = "Mirrors zones that are listed from right to left, from the bottom up, or both."


@click.command(name="distances")
@click.argument("sources", type=click.Path(path_type=Path), nargs=-1, required=True)
@recording_out_option
@option("--poses", _POSES, type=click.Path(path_type=Path), multiple=True)
@pose_format_option
@option("--wall", _WALL, "names", multiple=True)
@option("--plane", _PLANE, "planes", type=number_list(4), multiple=True)
@option("--zones", "COLUMNSxROWS of the sensor, as rows of the table list them.", default="1x1")
@option("--order", _ORDER, default="rows", type=click.Choice(["rows", "columns"]))
@option("--flip", _FLIP, default="none", type=click.Choice(_FLIPS))
@rotate_option
@invalid_option
@option("--fov-deg", "Field of view of all zones, degrees: H,V.", type=number_list(1, 2))
@option("--depth-unit-mm", _COUNTS, "unit_mm", type=float)
@posed_options
def command(sources: tuple[Path, ...], out: Path, **given: Any) -> None:  # noqa: ANN401
    """Import the distances of a single-pixel or few-zone sensor before flat walls.

    Each of SOURCES shows one wall: a file with a row of distances for each pose and --poses beside
    it, or a folder that holds measurements.csv and transforms.csv. Several readings at one pose
    stand in one row; their median is used.
    """
    from tofcorr.importing.distances.readings import layout_of, open_distances, sensor_lens
    from tofcorr.importing.images import DepthCoding
    from tofcorr.importing.posed import import_posed

    layout = layout_of(*(given.pop(name) for name in ("zones", "order", "flip", "rotate")))
    if layout.size == 1:
        # Along the one ray both kinds are the same.
        given["depth_kind"] = "radial"
    options = take_posed_options(given)
    lens = sensor_lens(layout, given.pop("fov_deg"))
    coding = DepthCoding(unit_mm=given.pop("unit_mm"), invalid=given.pop("invalid"))
    images = open_distances(sources, layout, lens, coding, **given)
    print_report(import_posed(images, out, options), out)
