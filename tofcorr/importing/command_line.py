"""What the commands of all importers share: options, and the report on the terminal.

Heavy packages are imported inside the functions, so that `--help` answers at once.
"""

from collections.abc import Callable, Mapping
from functools import reduce
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import click

from tofcorr.digits import at_most
from tofcorr.errors import ConfigError
from tofcorr.files import NewPath

if TYPE_CHECKING:
    from tofcorr.importing.images import DepthCoding
    from tofcorr.importing.intrinsics import GivenIntrinsics
    from tofcorr.importing.robot_images import PosedOptions

Command = TypeVar("Command", bound=Callable[..., Any])


def number_list(*counts: int) -> Callable[[str], tuple[float, ...]]:
    """Return an option's type: numbers separated by commas, as many as one of `counts`."""

    def numbers(text: str) -> tuple[float, ...]:
        try:
            found = tuple(map(float, text.split(",")))
        except ValueError:
            said = f"expected numbers separated by commas, got '{text}'."
            raise click.BadParameter(said) from None
        if len(found) not in counts:
            wanted = " or ".join(map(str, counts))
            raise click.BadParameter(f"expected {wanted} numbers, got {len(found)}.")
        return found

    return numbers


def adding(*options: Callable[[Command], Command]) -> Callable[[Command], Command]:
    """Return a decorator that adds options to a command, in this order."""
    return lambda command: reduce(lambda made, add: add(made), reversed(options), command)


def option(flag: str, text: str, *names: str, **more: Any) -> Callable[[Command], Command]:  # noqa: ANN401
    """Return an option with its help, of which a default is shown."""
    return click.option(flag, *names, show_default="default" in more, help=text, **more)


recording_out_option = option("--out", "Recording to write.", required=True, type=NewPath())
depth_kind_option = option(
    "--depth-kind", "z: along the optical axis; radial: along the viewing ray.",
    default="z", type=click.Choice(["z", "radial"]),
)  # fmt: skip
pose_format_option = option(
    "--pose-format", "Left out: told from the file.",
    type=click.Choice(["tum", "csv", "matrix", "matrices", "moveit"]),
)  # fmt: skip

intrinsics_options = adding(
    option("--intrinsics", "YAML, JSON, ROS camera_info, OpenCV, text of 3x3, or a shipped name."),
    option("--calibrate", "Calibrate the intrinsics from the boards.", is_flag=True),
    option("--focal", "Focal length F or FX,FY, pixels.", type=number_list(1, 2)),
    option("--centre", "Principal point CX,CY, pixels.", type=number_list(2)),
    option("--distortion", "With --focal: K1,K2,P1,P2[,K3...].", type=number_list(4, 5, 8, 12, 14)),
)
"""Adds the options that say where the camera intrinsics come from."""

_COUNTS = "Millimetres per count; left out: 1 for whole numbers, 1000 (metres) for floats."
_NONE = "Numbers that mean 'no return', besides NaN and those up to zero."
_TURNS = "Degrees clockwise by which images are turned to fit the intrinsics."
invalid_option = option("--invalid", _NONE, default="0,65535", type=number_list(*range(1, 9)))
_TURN = click.Choice(["0", "90", "180", "270"])
rotate_option = option("--rotate", _TURNS, default="0", type=_TURN)
coding_options = adding(
    option("--depth-unit-mm", _COUNTS, "unit_mm", type=float),
    invalid_option,
    option("--big-endian", "The two bytes of each number are swapped.", is_flag=True),
    rotate_option,
)
"""Adds the options that say how the numbers of depth images are to be read."""

_MOVING = "Also use images taken while the robot moved."
_FULL = "Pixels at or above this amplitude are saturated and not used."
posed_options = adding(
    option("--eye-to-hand", "The camera stands still; the robot moves the target.", is_flag=True),
    depth_kind_option,
    option("--time-offset-s", "Added to the images' time stamps.", default=0.0),
    option("--lag-s", "How much later images are stamped than poses; auto: found.", default="auto"),
    option("--pose-tolerance-s", "Largest time from an image to the nearest pose.", default=0.2),
    option("--keep-moving", _MOVING, "moving", default="leave_out", flag_value="keep"),
    option("--images-per-stop", "At most so many images of one stop of the robot.", default=3),
    option("--tolerance-mm", "How far a pixel of a wall may be from its plane.", default=30.0),
    option("--base-frame", "Name of the base.", default="base"),
    option("--tool-frame", "Name of the tool.", default="tool"),
    option("--camera-frame", "Of the camera; left out: as images call it, else 'camera'."),
    option("--saturation", _FULL, "saturation_amplitude", type=float),
    option("--modulation-frequency-hz", "If known.", type=float),
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
        ways = "--intrinsics FILE, --calibrate, or --focal and --centre"
        raise ConfigError(f"say where the intrinsics come from, in one way: {ways}.")
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

    values = {key: given.pop(key) for key in DepthCoding.model_fields}
    return DepthCoding.from_mapping(values | {"rotate": int(values["rotate"])}, command_name())


def take_posed_options(given: dict[str, Any], camera_frame: str = "") -> "PosedOptions":
    """Remove the options of `posed_options` from `given` and return what they say.

    Args:
        given: Click's values.
        camera_frame: What the images call the camera's frame; empty if they do not.

    Raises:
        ConfigError: A value is not allowed.
    """
    from tofcorr.importing.robot_images import PosedOptions

    given["frames"] = {
        "world": given.pop("base_frame"),
        "tool": given.pop("tool_frame"),
        "camera": given.pop("camera_frame") or camera_frame or "camera",
    }
    given["walls"] = {"tolerance_mm": given.pop("tolerance_mm")}
    own = {key: given.pop(key) for key in PosedOptions.model_fields if key in given}
    return PosedOptions.from_mapping(own, command_name())


def command_name() -> str:
    """Return what messages call the command that is run."""
    return click.get_current_context().command_path


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
    refused = list[str]()
    for reason, left_out in reasons.items():
        which = left_out[0] if len(left_out) == 1 else f"{len(left_out)} ({left_out[0]}, ...)"
        refused.append(f"  refused {which}: {reason}")
    for line in at_most(10, refused, f"{out / 'import.json'}"):
        click.echo(line)
    for warning in report["warnings"]:
        click.echo(f"Warning: {warning}", err=True)
