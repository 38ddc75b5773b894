"""A bag's images, poses and camera, ready to be imported."""

from collections.abc import Iterator
from contextlib import ExitStack, closing, contextmanager
from pathlib import Path

import numpy as np

from tofcorr.errors import CalibrationDataError, ConfigError
from tofcorr.importing.images import DepthCoding, DepthImage, amplitude_counts, depth_metres, turned
from tofcorr.importing.intrinsics import (
    GivenIntrinsics,
    intrinsics_from_mapping,
    read_named_intrinsics,
)
from tofcorr.importing.pose_track import PoseTrack, nearest
from tofcorr.importing.robot_images import RobotImages
from tofcorr.importing.rosbag.bag import Bag, TopicMessages, damage_reported
from tofcorr.importing.rosbag.tf_tree import base_from_tool, read_tf
from tofcorr.importing.run import Refusal, RefusedViewError

_SAME_IMAGE = 0.01
"""Seconds between the stamps of depth and amplitude of one exposure: a third of a frame at 30 Hz;
most drivers give both one stamp."""

_IMAGES = ("sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage")
_CAMERA_INFO = "sensor_msgs/msg/CameraInfo"


@contextmanager
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
) -> Iterator[RobotImages]:
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

    Yields:
        The images, to be read before the block ends, and the poses of the tool in the base.

    Raises:
        CalibrationDataError: The bag is damaged, or lacks something; the message says what.
        ConfigError: Intrinsics are named twice.
    """
    if camera_info is not None and intrinsics is not None:
        raise ConfigError("say where the intrinsics come from, in one way: not both --camera-info "
                          "and --intrinsics.")  # fmt: skip
    warnings: list[str] = []
    with closing(Bag(path)) as bag:
        _check_image_topics(bag, depth_topic, amplitude_topic)
        if intrinsics is not None:
            given = read_named_intrinsics(intrinsics)
        else:
            topic = _camera_info_topic(bag, depth_topic, camera_info)
            given, warnings = _read_camera_info(bag, topic, depth_topic)
        with damage_reported(path):
            edges = read_tf(bag)
        track = base_from_tool(edges, base_frame.lstrip("/"), tool_frame.lstrip("/"), str(path))
    with ExitStack() as opened:
        with damage_reported(path):
            topics = [topic for topic in (depth_topic, amplitude_topic) if topic is not None]
            messages = [opened.enter_context(closing(TopicMessages(path, t))) for t in topics]
            images = _images(messages, given, coding, track, str(path), warnings)
        yield images


def _images(
    messages: list[TopicMessages],
    intrinsics: GivenIntrinsics,
    coding: DepthCoding,
    track: PoseTrack,
    origin: str,
    warnings: list[str],
) -> RobotImages:
    """Put the messages of depth, and of amplitude if there are any, in the order of their times."""
    depth, amplitude = messages[0], messages[-1] if len(messages) > 1 else None
    order = np.argsort(depth.stamps, kind="stable")
    names = [f"{stamp:.6f}" for stamp in depth.stamps]
    refused, partner = [], order
    if amplitude is not None:
        by_time = np.argsort(amplitude.stamps, kind="stable")
        partner = by_time[nearest(amplitude.stamps[by_time], depth.stamps)]
        gap = np.abs(depth.stamps - amplitude.stamps[partner])
        if (gap > _SAME_IMAGE).all():
            raise CalibrationDataError(
                f"{origin}: no image of {amplitude.topic} is stamped within "
                f"{1e3 * _SAME_IMAGE:.0f} ms of one of {depth.topic}; the nearest is "
                f"{gap.min():.3f} s away."
            )
        reason = f"{amplitude.topic} has no image of its time"
        refused = [Refusal(names[k], reason) for k in order if gap[k] > _SAME_IMAGE]
        order = order[gap[order] <= _SAME_IMAGE]
    camera = intrinsics.camera(_first_size(depth, order, coding, origin))

    def read(number: int) -> DepthImage:
        place = int(order[number])
        metres = depth_metres(depth.image(place), coding, depth.topic)
        counts = None
        if amplitude is not None:
            counts = amplitude.image(int(partner[place]))
            counts = amplitude_counts(counts, coding, amplitude.topic)
        return DepthImage(metres, counts).of(camera)

    if not depth.stamped:
        warnings.append(
            f"The headers of {depth.topic} hold no time stamps; the times of receipt are used, "
            "which jitter by the delays of the network."
        )
    return RobotImages(
        origin=origin,
        names=[names[k] for k in order],
        camera=camera,
        read=read,
        track=track,
        times=depth.stamps[order],
        refused=refused,
        warnings=warnings,
        camera_frame=depth.frame_id.lstrip("/"),
    )


def _first_size(
    depth: TopicMessages, order: np.ndarray, coding: DepthCoding, origin: str
) -> tuple[int, int]:
    """Return width and height of the first image that can be decoded."""
    reason = ""
    for place in order.tolist():
        try:
            height, width = turned(depth.image(place), coding.rotate).shape
        except RefusedViewError as refusal:
            reason = reason or str(refusal)
            continue
        return width, height
    raise CalibrationDataError(
        f"{origin}: none of {len(order)} depth images can be used; the first: {reason}."
    )


def _check_image_topics(bag: Bag, depth: str, amplitude: str | None) -> None:
    """Refuse topics that are missing, of another type, or exchanged; the message lists all."""
    for topic, option in ((depth, "--depth"), (amplitude, "--amplitude")):
        if topic is not None:
            _check(bag, topic, option, _IMAGES)
            bag.first(topic)
    seen = _encoding(bag, depth)
    if not seen.startswith("mono"):
        return
    others = [topic for topic, kind in bag.types.items() if kind in _IMAGES]
    for topic in others if amplitude is None else [amplitude]:
        beside = _encoding(bag, topic)
        # By ROS's convention (REP 118) depth has these encodings, and amplitude has not.
        if beside.startswith(("16UC1", "32FC1")):
            advice = f"name {topic} with --depth" if amplitude is None else "swap them"
            raise CalibrationDataError(
                f"{bag.path}: --depth {depth} is coded '{seen}', as amplitudes are, and {topic} "
                f"'{beside}', as depth is: {advice}."
            )


def _camera_info_topic(bag: Bag, depth: str, given: str | None) -> str:
    """Return the topic of the depth camera's intrinsics.

    Args:
        bag: The bag.
        depth: The topic of depth images.
        given: What the user named; None: the `camera_info` beside the images, or the only one.

    Raises:
        CalibrationDataError: There is none, or it is not clear which.
    """
    if given is not None:
        _check(bag, given, "--camera-info", (_CAMERA_INFO,))
        return given
    found = [topic for topic, kind in bag.types.items() if kind == _CAMERA_INFO]
    space = depth
    while "/" in space:
        space = space.rpartition("/")[0]
        if f"{space}/camera_info" in found:
            return f"{space}/camera_info"
    if len(found) == 1:
        return found[0]
    many = f"several topics hold camera intrinsics: {', '.join(sorted(found))}"
    raise CalibrationDataError(
        f"{bag.path}: {many if found else 'no topic holds camera intrinsics (CameraInfo)'}. "
        "Name one with --camera-info, or a file with --intrinsics."
    )


def _read_camera_info(bag: Bag, topic: str, depth: str) -> tuple[GivenIntrinsics, list[str]]:
    """Read the intrinsics of a topic, and what is to be said of them.

    By ROS's convention a topic `image_rect` is undistorted: then the matrix P holds.

    Raises:
        CalibrationDataError: There is no message, or its lens model is not supported.
    """
    message = bag.first(topic)
    # ROS 2 writes the names small, ROS 1 large.
    matrix, lens, projection = (
        np.ravel(getattr(message, name if hasattr(message, name) else name.upper())).tolist()
        for name in "kdp"
    )
    if not any(matrix):
        raise CalibrationDataError(
            f"{bag.path}: {topic} holds a matrix K of zeros: the driver knows no calibration. Name "
            "a file with --intrinsics."
        )
    values = {
        "K": matrix,
        "distortion": lens,
        "distortion_model": str(message.distortion_model) or "none",
    }
    if message.width and message.height:
        values |= {"width": int(message.width), "height": int(message.height)}
    warnings = []
    if "image_rect" in depth and any(lens):
        matrix = [*projection[:3], *projection[4:7], *projection[8:11]]
        values |= {"K": matrix, "distortion": []}
        warnings.append(
            f"{depth} is undistorted by its name: the projection P of {topic} is used, without "
            "its distortion. State --intrinsics if that is wrong."
        )
    return intrinsics_from_mapping(values, f"{bag.path}: {topic}"), warnings


def _check(bag: Bag, topic: str, option: str, wanted: tuple[str, ...]) -> None:
    kind = bag.types.get(topic)
    if kind in wanted:
        return
    names = " or ".join(name.replace("/msg/", "/") for name in wanted)
    found = "there is no such topic" if kind is None else f"it is {kind.replace('/msg/', '/')}"
    raise CalibrationDataError(
        f"{bag.path}: {option} {topic}: expected {names}, {found}. The topics: "
        f"{bag.listed_topics()}."
    )


def _encoding(bag: Bag, topic: str) -> str:
    message = next((message for _, message in bag.messages(topic)), None)
    return str(getattr(message, "encoding", None) or getattr(message, "format", ""))
