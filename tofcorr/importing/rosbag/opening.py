"""A bag's images, poses and camera, ready to be imported."""

from contextlib import ExitStack, closing
from dataclasses import dataclass
from pathlib import Path

from tofcorr.errors import ConfigError
from tofcorr.importing.images.coding import DepthCoding
from tofcorr.importing.intrinsics_file import read_named_intrinsics
from tofcorr.importing.poses.track import PoseTrack
from tofcorr.importing.rosbag.bag import Bag, damage_reported
from tofcorr.importing.rosbag.messages import TopicMessages
from tofcorr.importing.rosbag.source import BagSource
from tofcorr.importing.rosbag.tf_tree import base_from_tool, read_tf
from tofcorr.importing.rosbag.topics import (
    camera_info_topic,
    check_image_topics,
    read_camera_info,
)


@dataclass(frozen=True, kw_only=True)
class OpenedBag:
    """What a bag holds.

    Attributes:
        source: The images; to be closed after use.
        track: Poses of the tool in the base.
        camera_frame: What the images' headers call the camera's frame; empty if nothing.
        warnings: Sentences for people.
    """

    source: BagSource
    track: PoseTrack
    camera_frame: str
    warnings: list[str]


def open_bag(
    path: Path,
    depth_topic: str,
    coding: DepthCoding,
    *,
    base_frame: str,
    tool_frame: str,
    amplitude_topic: str | None = None,
    camera_info: str | None = None,
    intrinsics: str | None = None,
) -> OpenedBag:
    """Open a bag and read everything but the images.

    Args:
        path: The file or folder.
        depth_topic: Topic of the depth images.
        coding: How depth is to be read.
        base_frame: The robot's base in tf.
        tool_frame: The robot's tool in tf.
        amplitude_topic: Topic of the amplitude images.
        camera_info: Topic of the intrinsics; None: the one beside the images.
        intrinsics: A file of intrinsics, or a shipped name, instead.

    Raises:
        CalibrationDataError: The bag is damaged, or lacks something; the message says what.
        ConfigError: Intrinsics are named twice.
    """
    if camera_info is not None and intrinsics is not None:
        raise ConfigError("say where the intrinsics come from, in one way: not both --camera-info "
                          "and --intrinsics.")  # fmt: skip
    warnings: list[str] = []
    with closing(Bag(path)) as bag:
        check_image_topics(bag, depth_topic, amplitude_topic)
        if intrinsics is not None:
            given = read_named_intrinsics(intrinsics)
        else:
            topic = camera_info_topic(bag, depth_topic, camera_info)
            given, warnings = read_camera_info(bag, topic, depth_topic)
        with damage_reported(path):
            edges = read_tf(bag)
        track = base_from_tool(edges, base_frame.lstrip("/"), tool_frame.lstrip("/"), str(path))
    with ExitStack() as unless_complete, damage_reported(path):
        depth = unless_complete.enter_context(closing(TopicMessages(path, depth_topic)))
        amplitude = None
        if amplitude_topic is not None:
            amplitude = unless_complete.enter_context(closing(TopicMessages(path, amplitude_topic)))
        source = BagSource(depth, amplitude, given, coding, str(path))
        unless_complete.pop_all()  # Now `source` closes them.
    return OpenedBag(
        source=source, track=track, camera_frame=depth.frame_id.lstrip("/"), warnings=warnings
    )
