"""The options that all importers of a moving robot's images share."""

from collections.abc import Callable
from typing import TYPE_CHECKING, Any, TypeVar

import click

if TYPE_CHECKING:
    from tofcorr.importing.posed.options import PosedOptions

Command = TypeVar("Command", bound=Callable[..., Any])

_OPTIONS = (
    click.option(
        "--eye-to-hand",
        is_flag=True,
        help="The camera stands still; the robot moves the target in front of it.",
    ),
    click.option(
        "--depth-kind",
        type=click.Choice(["z", "radial"]),
        default="z",
        show_default=True,
        help="z: along the optical axis; radial: along the viewing ray.",
    ),
    click.option(
        "--time-offset-s",
        type=float,
        default=0.0,
        show_default=True,
        help="Added to the images' time stamps, if the clocks differ by a known amount.",
    ),
    click.option(
        "--lag-s",
        type=float,
        help="How much later images are stamped than poses; left out: estimated.",
    ),
    click.option(
        "--pose-tolerance-s",
        type=float,
        default=0.2,
        show_default=True,
        help="Largest time between an image and the nearest pose.",
    ),
    click.option(
        "--keep-moving", is_flag=True, help="Also use images taken while the robot moved."
    ),
    click.option(
        "--images-per-stop",
        type=int,
        default=3,
        show_default=True,
        help="At most so many images of one stop of the robot.",
    ),
    click.option(
        "--tolerance-mm",
        type=float,
        default=30.0,
        show_default=True,
        help="How far a pixel of a wall may be from its plane: the error before calibration.",
    ),
    click.option("--base-frame", default="base", show_default=True, help="Name of the base."),
    click.option("--tool-frame", default="tool", show_default=True, help="Name of the tool."),
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


def posed_options(command: Command) -> Command:
    """Add the options that say how images and poses become a recording."""
    for option in reversed(_OPTIONS):
        command = option(command)
    return command


def take_posed_options(given: dict[str, Any], where: str, camera_frame: str = "") -> "PosedOptions":
    """Remove the options of `posed_options` from `given` and return what they say.

    Args:
        given: Click's values.
        where: The command, for messages.
        camera_frame: What the images call the camera's frame; empty if they do not.

    Raises:
        ConfigError: A value is not allowed.
    """
    from tofcorr.importing.posed.options import PosedOptions

    lag = given.pop("lag_s")
    frames = {
        name: given.pop(key)
        for name, key in (
            ("world", "base_frame"),
            ("tool", "tool_frame"),
            ("camera", "camera_frame"),
        )
    }
    frames["camera"] = frames["camera"] or camera_frame or "camera"
    mapping = {
        "walls": {"tolerance_mm": given.pop("tolerance_mm")},
        "lag_s": "auto" if lag is None else lag,
        "moving": "keep" if given.pop("keep_moving") else "leave_out",
        "frames": frames,
    }
    same = (
        *("eye_to_hand", "depth_kind", "time_offset_s", "pose_tolerance_s", "images_per_stop"),
        *("saturation_amplitude", "modulation_frequency_hz"),
    )
    return PosedOptions.from_mapping(mapping | {key: given.pop(key) for key in same}, where)
