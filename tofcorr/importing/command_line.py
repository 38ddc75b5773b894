"""What the commands of all importers share: intrinsics, progress, and the report on the terminal.

Heavy packages are imported inside the functions, so that `--help` answers at once.
"""

from collections.abc import Callable, Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import click

from tofcorr.errors import ConfigError
from tofcorr.progress import through

if TYPE_CHECKING:
    from tofcorr.importing.given_intrinsics import GivenIntrinsics
    from tofcorr.importing.images.coding import DepthCoding
    from tofcorr.importing.report import ImportReport

Command = TypeVar("Command", bound=Callable[..., Any])
Item = TypeVar("Item")

# Largest number of reasons that the terminal lists. Chosen by hand: they fit on one screen, and
# import.json lists every view that was left out.
_FEW_REFUSALS = 10


class NumberList(click.ParamType):
    """Numbers separated by commas.

    Args:
        counts: How many numbers are allowed.
    """

    name = "numbers"

    def __init__(self, *counts: int) -> None:
        self._counts = counts

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:  # noqa: ANN401
        """Return a tuple of numbers, or refuse the text."""
        if not isinstance(value, str):
            return value
        try:
            numbers = tuple(float(number) for number in value.split(","))
        except ValueError:
            self.fail(f"expected numbers separated by commas, got '{value}'.", param, ctx)
        if len(numbers) not in self._counts:
            wanted = " or ".join(map(str, self._counts))
            self.fail(f"expected {wanted} numbers, got {len(numbers)}.", param, ctx)
        return numbers


_INTRINSICS_OPTIONS = (
    click.option(
        "--intrinsics",
        help="YAML or JSON with K and distortion, ROS camera_info, OpenCV file, text of a 3x3 "
        "matrix, or a shipped name.",
    ),
    click.option("--calibrate", is_flag=True, help="Calibrate the intrinsics from the boards."),
    click.option("--focal", type=NumberList(1, 2), help="Focal length F or FX,FY, pixels."),
    click.option("--centre", type=NumberList(2), help="Principal point CX,CY, pixels."),
    click.option(
        "--distortion",
        type=NumberList(4, 5, 8, 12, 14),
        help="With --focal: K1,K2,P1,P2[,K3...].",
    ),
)


def intrinsics_options(command: Command) -> Command:
    """Add the options that say where the camera intrinsics come from."""
    for option in reversed(_INTRINSICS_OPTIONS):
        command = option(command)
    return command


def take_intrinsics(given: dict[str, Any]) -> "GivenIntrinsics | None":
    """Remove the options of `intrinsics_options` from `given` and return what they say.

    Returns:
        The camera intrinsics; None to calibrate them.

    Raises:
        ConfigError: They come from no source, or from more than one.
    """
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
    from tofcorr.importing.given_intrinsics import intrinsics_from_numbers
    from tofcorr.importing.intrinsics_file import read_named_intrinsics

    if path is not None:
        return read_named_intrinsics(path)
    source = "--focal, --centre, --distortion"
    return intrinsics_from_numbers(focal, centre, distortion or (), source)


_CODING_OPTIONS = (
    click.option(
        "--depth-unit-mm",
        "unit_mm",
        type=float,
        help="Millimetres per count; left out: 1 for whole numbers, 1000 (metres) for floats.",
    ),
    click.option(
        "--invalid",
        type=NumberList(*range(1, 9)),
        default="0,65535",
        show_default=True,
        help="Numbers that mean 'no return', besides NaN.",
    ),
    click.option("--big-endian", is_flag=True, help="The two bytes of each number are swapped."),
    click.option(
        "--rotate",
        type=click.Choice(["0", "90", "180", "270"]),
        default="0",
        show_default=True,
        help="Degrees clockwise by which images are turned to fit the intrinsics.",
    ),
)


def coding_options(command: Command) -> Command:
    """Add the options that say how the numbers of depth images are to be read."""
    for option in reversed(_CODING_OPTIONS):
        command = option(command)
    return command


def take_coding(given: dict[str, Any], where: str) -> "DepthCoding":
    """Remove the options of `coding_options` from `given` and return what they say.

    Args:
        given: Click's values.
        where: The command, for messages.

    Raises:
        ConfigError: A value is not allowed.
    """
    from tofcorr.importing.images.coding import DepthCoding

    values = {key: given.pop(key) for key in ("unit_mm", "invalid", "big_endian", "rotate")}
    return DepthCoding.from_mapping(values | {"rotate": int(values["rotate"])}, where)


def progress_bar(items: Iterable[Item], step: str) -> Iterable[Item]:
    """Show a progress bar on standard error, if that is a terminal."""
    return through(items, step, "view")


def print_report(report: "ImportReport", out: Path) -> None:
    """Print how many frames were written, what was left out and why, and the warnings."""
    views = {view.view for view in report.views}
    frames, walls = len(report.views), len(report.findings.get("walls", ()))
    if walls:
        of_walls = f"{walls} wall{'s' if walls > 1 else ''}"
        click.echo(f"{frames} frames of {of_walls}, from {len(views)} images, written to {out}")
    else:
        click.echo(f"{frames} of {frames + len(report.refused)} views imported to {out}")
    reasons: dict[str, list[str]] = {}
    for refusal in report.refused:
        reasons.setdefault(refusal.reason, []).append(refusal.view)
    for reason, left_out in list(reasons.items())[:_FEW_REFUSALS]:
        which = left_out[0] if len(left_out) == 1 else f"{len(left_out)} ({left_out[0]}, ...)"
        click.echo(f"  refused {which}: {reason}")
    if len(reasons) > _FEW_REFUSALS:
        click.echo(f"  and {len(reasons) - _FEW_REFUSALS} more reasons: see import.json")
    for warning in report.warnings:
        click.echo(f"Warning: {warning}", err=True)
