"""What the commands of all importers share: intrinsics, progress, and the report on the terminal.

Heavy packages are imported inside the functions, so that `--help` answers at once.
"""

import sys
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import click

from tofcorr.errors import ConfigError

if TYPE_CHECKING:
    from tofcorr.importing.given_intrinsics import GivenIntrinsics
    from tofcorr.importing.report import ImportReport

Command = TypeVar("Command", bound=Callable[..., Any])
Item = TypeVar("Item")

# Largest number of refused views that the terminal lists. Chosen by hand: they fit on one screen,
# and import.json lists all.
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
        help="YAML or JSON with K and distortion, ROS camera_info, OpenCV file, or a shipped name.",
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
    from tofcorr.importing.intrinsics_file import read_intrinsics

    if path is not None:
        from tofcorr.options import shipped_file

        return read_intrinsics(shipped_file(path, "import"))
    source = "--focal, --centre, --distortion"
    return intrinsics_from_numbers(focal, centre, distortion or (), source)


def progress_bar(items: Iterable[Item], step: str) -> Iterable[Item]:
    """Show a progress bar on standard error, if that is a terminal."""
    from tqdm import tqdm

    return tqdm(items, desc=step, unit="view", file=sys.stderr, disable=None)


def print_report(report: "ImportReport", out: Path) -> None:
    """Print how many views were imported, which were refused, and the warnings."""
    views = len(report.views)
    click.echo(f"{views} of {views + len(report.refused)} views imported to {out}")
    for refusal in report.refused[:_FEW_REFUSALS]:
        click.echo(f"  refused {refusal.view}: {refusal.reason}")
    if len(report.refused) > _FEW_REFUSALS:
        click.echo(f"  and {len(report.refused) - _FEW_REFUSALS} more: see import.json")
    for warning in report.warnings:
        click.echo(f"Warning: {warning}", err=True)
