"""What the commands of all importers share: options, progress, and the report on the terminal.

Heavy packages are imported inside the functions, so that `--help` answers at once.
"""

from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import click

from tofcorr.errors import ConfigError
from tofcorr.progress import through

if TYPE_CHECKING:
    from tofcorr.importing.images import DepthCoding
    from tofcorr.importing.intrinsics import GivenIntrinsics
    from tofcorr.importing.robot_images import PosedOptions

Command = TypeVar("Command", bound=Callable[..., Any])
Item = TypeVar("Item")


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


def _adding(*options: Callable[[Command], Command]) -> Callable[[Command], Command]:
    """Return a decorator that adds options to a command, in this order."""

    def add(command: Command) -> Command:
        for option in reversed(options):
            command = option(command)
        return command

    return add


def shown_option(
    flag: str,
    default: float | str,
    text: str,
    *names: str,
    **more: Any,  # noqa: ANN401
) -> Callable[[Command], Command]:
    """Return an option whose help shows its default."""
    return click.option(flag, *names, default=default, show_default=True, help=text, **more)


depth_kind_option = shown_option(
    "--depth-kind",
    "z",
    "z: along the optical axis; radial: along the viewing ray.",
    type=click.Choice(["z", "radial"]),
)

intrinsics_options = _adding(
    click.option(
        "--intrinsics",
        help="YAML or JSON with K and distortion, ROS camera_info, OpenCV file, text of a 3x3 "
        "matrix, or a shipped name.",
    ),
    click.option("--calibrate", is_flag=True, help="Calibrate the intrinsics from the boards."),
    click.option("--focal", type=NumberList(1, 2), help="Focal length F or FX,FY, pixels."),
    click.option("--centre", type=NumberList(2), help="Principal point CX,CY, pixels."),
    click.option(
        "--distortion", type=NumberList(4, 5, 8, 12, 14), help="With --focal: K1,K2,P1,P2[,K3...]."
    ),
)
"""Adds the options that say where the camera intrinsics come from."""

pose_format_option = click.option(
    "--pose-format",
    type=click.Choice(["tum", "csv", "matrix", "matrices", "moveit"]),
    help="Left out: told from the file.",
)

coding_options = _adding(
    click.option(
        "--depth-unit-mm",
        "unit_mm",
        type=float,
        help="Millimetres per count; left out: 1 for whole numbers, 1000 (metres) for floats.",
    ),
    shown_option(
        "--invalid",
        "0,65535",
        "Numbers that mean 'no return', besides NaN.",
        type=NumberList(*range(1, 9)),
    ),
    click.option("--big-endian", is_flag=True, help="The two bytes of each number are swapped."),
    shown_option(
        "--rotate",
        "0",
        "Degrees clockwise by which images are turned to fit the intrinsics.",
        type=click.Choice(["0", "90", "180", "270"]),
    ),
)
"""Adds the options that say how the numbers of depth images are to be read."""

_CLOCKS = "Added to the images' time stamps, if the clocks differ by a known amount."
_TOLERANCE = "How far a pixel of a wall may be from its plane: the error before calibration."

posed_options = _adding(
    click.option(
        "--eye-to-hand",
        is_flag=True,
        help="The camera stands still; the robot moves the target in front of it.",
    ),
    depth_kind_option,
    shown_option("--time-offset-s", 0.0, _CLOCKS),
    click.option(
        "--lag-s",
        type=float,
        help="How much later images are stamped than poses; left out: estimated.",
    ),
    shown_option("--pose-tolerance-s", 0.2, "Largest time between an image and the nearest pose."),
    click.option(
        "--keep-moving", is_flag=True, help="Also use images taken while the robot moved."
    ),
    shown_option("--images-per-stop", 3, "At most so many images of one stop of the robot."),
    shown_option("--tolerance-mm", 30.0, _TOLERANCE),
    shown_option("--base-frame", "base", "Name of the base."),
    shown_option("--tool-frame", "tool", "Name of the tool."),
    click.option(
        "--camera-frame", help="Of the camera; left out: as images call it, else 'camera'."
    ),
    click.option(
        "--saturation",
        "saturation_amplitude",
        type=float,
        help="Pixels at or above this amplitude are saturated and not used.",
    ),
    click.option("--modulation-frequency-hz", type=float, help="If known."),
)
"""Adds the options that say how images and poses of a moving robot become a recording."""


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
    from tofcorr.importing.intrinsics import intrinsics_from_numbers, read_named_intrinsics

    if path is not None:
        return read_named_intrinsics(path)
    source = "--focal, --centre, --distortion"
    return intrinsics_from_numbers(focal, centre, distortion or (), source)


def take_coding(given: dict[str, Any]) -> "DepthCoding":
    """Remove the options of `coding_options` from `given` and return what they say.

    Raises:
        ConfigError: A value is not allowed.
    """
    from tofcorr.importing.images import DepthCoding

    values = {key: given.pop(key) for key in ("unit_mm", "invalid", "big_endian", "rotate")}
    return DepthCoding.from_mapping(values | {"rotate": int(values["rotate"])}, _command_name())


def take_posed_options(given: dict[str, Any], camera_frame: str = "") -> "PosedOptions":
    """Remove the options of `posed_options` from `given` and return what they say.

    Args:
        given: Click's values.
        camera_frame: What the images call the camera's frame; empty if they do not.

    Raises:
        ConfigError: A value is not allowed.
    """
    from tofcorr.importing.robot_images import PosedOptions

    lag, world, tool = (given.pop(key) for key in ("lag_s", "base_frame", "tool_frame"))
    camera = given.pop("camera_frame") or camera_frame or "camera"
    mapping = {
        "walls": {"tolerance_mm": given.pop("tolerance_mm")},
        "lag_s": "auto" if lag is None else lag,
        "moving": "keep" if given.pop("keep_moving") else "leave_out",
        "frames": {"world": world, "tool": tool, "camera": camera},
    }
    same = (
        *("eye_to_hand", "depth_kind", "time_offset_s", "pose_tolerance_s", "images_per_stop"),
        *("saturation_amplitude", "modulation_frequency_hz"),
    )
    given_same = {key: given.pop(key) for key in same}
    return PosedOptions.from_mapping(mapping | given_same, _command_name())


def _command_name() -> str:
    """Return what messages call the command that is run."""
    return f"tofcorr import {click.get_current_context().info_name}"


def progress_bar(items: Iterable[Item], step: str) -> Iterable[Item]:
    """Show a progress bar on standard error, if that is a terminal."""
    return through(items, step, "view")


def print_report(report: Mapping[str, Any], out: Path) -> None:
    """Print how many frames were written, what was left out and why, and the warnings.

    Ten reasons fit on one screen; `import.json` lists every view that was left out.
    """
    frames, walls = len(report["views"]), len(report.get("walls", ()))
    if walls:
        of_walls = f"{walls} wall{'s' if walls > 1 else ''}"
        images = len({view["view"] for view in report["views"]})
        click.echo(f"{frames} frames of {of_walls}, from {images} images, written to {out}")
    else:
        click.echo(f"{frames} of {frames + len(report['refused'])} views imported to {out}")
    reasons: dict[str, list[str]] = {}
    for refusal in report["refused"]:
        reasons.setdefault(refusal["reason"], []).append(refusal["view"])
    for reason, left_out in list(reasons.items())[:10]:
        which = left_out[0] if len(left_out) == 1 else f"{len(left_out)} ({left_out[0]}, ...)"
        click.echo(f"  refused {which}: {reason}")
    if len(reasons) > 10:
        click.echo(f"  and {len(reasons) - 10} more reasons: see import.json")
    for warning in report["warnings"]:
        click.echo(f"Warning: {warning}", err=True)
