"""`tofcorr import`: recorded images become a recording, one sub-command a source."""

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from tofcorr.cli.config_option import ConfigName
from tofcorr.errors import ConfigError

if TYPE_CHECKING:
    from tofcorr.importing.lens import Lens
    from tofcorr.importing.report import ImportReport

_FEW_REFUSALS = 10


@click.group(context_settings={"help_option_names": ["-h", "--help"]})
def command() -> None:
    """Turn recorded images into a recording."""


class _Numbers(click.ParamType):
    """Numbers separated by commas."""

    name = "numbers"

    def __init__(self, *counts: int) -> None:
        self._counts = counts

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:  # noqa: ANN401
        if not isinstance(value, str):
            return value
        try:
            numbers = tuple(float(part) for part in value.split(","))
        except ValueError:
            self.fail(f"expected numbers separated by commas, got '{value}'.", param, ctx)
        if len(numbers) not in self._counts:
            wanted = " or ".join(map(str, self._counts))
            self.fail(f"expected {wanted} numbers, got {len(numbers)}.", param, ctx)
        return numbers


class _BoardSize(click.ParamType):
    """Inner corners as COLUMNSxROWS."""

    name = "CxR"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:  # noqa: ANN401
        if not isinstance(value, str):
            return value
        parts = value.lower().split("x")
        if len(parts) != 2 or not all(part.isdecimal() for part in parts):
            self.fail(f"expected inner corners such as 5x7, got '{value}'.", param, ctx)
        return int(parts[0]), int(parts[1])


@command.command()
@click.argument("folder", type=click.Path(path_type=Path))
@click.option("--out", required=True, type=click.Path(path_type=Path), help="Recording to write.")
@click.option(
    "--depth",
    "depth_pattern",
    default="{view}_depth.png",
    show_default=True,
    help="Names of the depth images; {view} (or *) is what a pair of images shares.",
)
@click.option(
    "--infrared",
    "infrared_pattern",
    default="{view}_ir.png",
    show_default=True,
    help="Names of the infrared images.",
)
@click.option(
    "--board", required=True, type=_BoardSize(), help="Inner corners (not squares), such as 5x7."
)
@click.option("--square-mm", required=True, type=float, help="Side of a square, millimetres.")
@click.option(
    "--depth-unit-mm",
    default=1.0,
    show_default=True,
    help="Millimetres per count of the depth images; 0 counts mean no return.",
)
@click.option(
    "--depth-kind",
    type=click.Choice(["z", "radial"]),
    default="z",
    show_default=True,
    help="z: along the optical axis; radial: along the viewing ray.",
)
@click.option(
    "--intrinsics",
    type=ConfigName("import"),
    help="YAML or JSON with K and distortion, ROS camera_info, OpenCV file, or a shipped name.",
)
@click.option("--calibrate", is_flag=True, help="Calibrate the intrinsics from the boards.")
@click.option("--focal", type=_Numbers(1, 2), help="Focal length F or FX,FY, pixels.")
@click.option("--centre", type=_Numbers(2), help="Principal point CX,CY, pixels.")
@click.option(
    "--distortion", type=_Numbers(4, 5, 8, 12, 14), help="With --focal: K1,K2,P1,P2[,K3...]."
)
@click.option(
    "--saturation",
    "saturation_counts",
    default=65535.0,
    show_default=True,
    help="Infrared counts from which a pixel is saturated and not used.",
)
@click.option(
    "--margin-squares",
    default=0.0,
    show_default=True,
    help="How far the mask reaches beyond the outermost inner corners; 1: edge of the squares.",
)
@click.option(
    "--max-reprojection-px",
    default=0.5,
    show_default=True,
    help="Views whose corners miss by more (root mean square) are refused.",
)
@click.option("--modulation-frequency-hz", "modulation_frequency", type=float, help="If known.")
def checkerboard(folder: Path, out: Path, **given: Any) -> None:  # noqa: ANN401 - click's values
    """Import 16-bit PNG depth and infrared images of a checkerboard in FOLDER.

    The board's corners in the infrared image give the plane of each view; depth is what is judged
    against it. Views that cannot be used are left out, and import.json in the recording says why.
    """
    from tqdm import tqdm

    from tofcorr.importing.checkerboard.importer import import_checkerboard
    from tofcorr.importing.checkerboard.options import CheckerboardOptions

    lens = _lens(given)
    columns, rows = given.pop("board")
    in_metres = {
        "square_length": given.pop("square_mm") * 1e-3,
        "depth_unit": given.pop("depth_unit_mm") * 1e-3,
    }
    options = CheckerboardOptions.from_mapping(
        {**given, **in_metres, "board_columns": columns, "board_rows": rows},
        "tofcorr import checkerboard",
    )
    report = import_checkerboard(
        folder,
        out,
        options,
        lens,
        progress=lambda items, step: tqdm(items, desc=step, unit="view", file=sys.stderr),
    )
    _tell(report, out)


def _lens(given: dict[str, Any]) -> "Lens | None":
    """Return the lens that the options name; None to calibrate it."""
    path, calibrate = given.pop("intrinsics"), given.pop("calibrate")
    focal, centre, distortion = (given.pop(key) for key in ("focal", "centre", "distortion"))
    if sum([path is not None, calibrate, focal is not None]) != 1:
        raise ConfigError(
            "say where the intrinsics come from, in one way: --intrinsics FILE, "
            "--calibrate, or --focal and --centre."
        )
    if (focal is None) != (centre is None) or (distortion and focal is None):
        raise ConfigError("--focal and --centre go together, and --distortion with them.")
    if calibrate:
        return None
    from tofcorr.importing.intrinsics_file import read_lens
    from tofcorr.importing.lens import lens_from_numbers

    if path is not None:
        from tofcorr.options import shipped_file

        return read_lens(shipped_file(path, "import"))
    return lens_from_numbers(focal, centre, distortion or (), "--focal, --centre, --distortion")


def _tell(report: "ImportReport", out: Path) -> None:
    views = len(report.views)
    click.echo(f"{views} of {views + len(report.refused)} views imported to {out}")
    for refusal in report.refused[:_FEW_REFUSALS]:
        click.echo(f"  refused {refusal.view}: {refusal.reason}")
    if len(report.refused) > _FEW_REFUSALS:
        click.echo(f"  and {len(report.refused) - _FEW_REFUSALS} more: see import.json")
    for warning in report.warnings:
        click.echo(f"Warning: {warning}", err=True)
