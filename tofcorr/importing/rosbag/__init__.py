"""ROS bags: depth images and the robot's transforms, read one message at a time.

`source` gives access to the messages of a topic by number, decodes images, and follows the
transforms from base to tool.
"""

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from tofcorr.importing.command_line import (
    adding,
    coding_options,
    option,
    posed_options,
    print_report,
    recording_out_option,
    take_coding,
    take_posed_options,
)

if TYPE_CHECKING:
    from tofcorr.importing.robot_images import PosedOptions, RobotImages

bag_options = adding(
    option("--amplitude", "Topic of the amplitude (infrared) images, 16 bits.", "amplitude_topic"),
    option("--camera-info", "Topic of the intrinsics; left out: beside the images."),
    option("--intrinsics", "A file of intrinsics or a shipped name, instead of --camera-info."),
    coding_options,
    posed_options,
)
"""Adds the options that say how a bag is read, besides `--depth`."""


@contextmanager
def opened(
    bag: Path, given: Mapping[str, Any], *, grows: bool = False
) -> Iterator[tuple["RobotImages", "PosedOptions"]]:
    """Open a bag as the options of `--depth` and `bag_options` say; yield images and options."""
    from tofcorr.importing.rosbag.source import open_bag

    given = dict(given)
    coding, depth = take_coding(given), given.pop("depth_topic")
    frames = {key: given[key] for key in ("base_frame", "tool_frame")}
    topics = {key: given.pop(key) for key in ("amplitude_topic", "camera_info", "intrinsics")}
    with open_bag(bag, depth, coding, **frames, **topics, grows=grows) as images:
        yield images, take_posed_options(given, images.camera_frame)


@click.command(name="rosbag")
@click.argument("bag", type=click.Path(path_type=Path))
@recording_out_option
@option("--depth", "Topic of the depth images.", "depth_topic", required=True)
@bag_options
def command(bag: Path, out: Path, **given: Any) -> None:  # noqa: ANN401 - click's values
    """Import BAG: a ROS 1 .bag, a ROS 2 folder, or an .mcap or .db3 file.

    The poses are those of --tool-frame in --base-frame in the bag's tf and tf_static. No board is
    needed: walls, floor and tables are found in the depth, and their planes are estimated together
    with the calibration. import.json in the recording says which images were left out, and why.
    """
    from tofcorr.importing.posed import import_posed

    with opened(bag, given) as (images, options):
        report = import_posed(images, out, options)
    print_report(report, out)
