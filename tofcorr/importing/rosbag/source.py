"""A bag's images, camera, and the robot's transforms from base to tool, ready to be imported."""

from collections.abc import Iterable, Iterator
from contextlib import ExitStack, closing, contextmanager
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
import torch

from tofcorr.errors import CalibrationDataError, ConfigError
from tofcorr.geometry import se3
from tofcorr.importing.images import (
    DepthCoding,
    DepthImage,
    camera_of,
    coded_image,
    of_size,
    turned,
)
from tofcorr.importing.intrinsics import (
    GivenIntrinsics,
    intrinsics_from_mapping,
    read_named_intrinsics,
)
from tofcorr.importing.pose_files import rigid_transforms
from tofcorr.importing.pose_track import PoseTrack, nearest
from tofcorr.importing.robot_images import RobotImages
from tofcorr.importing.rosbag.bag import Bag, TopicMessages, damage_reported, seconds
from tofcorr.importing.run import Refused

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
            parents, poses = _read_tf(bag)
        frames = base_frame.lstrip("/"), tool_frame.lstrip("/")
        track = _base_from_tool(parents, poses, *frames, str(path))
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
    refused, partner = Refused(), order
    if amplitude is not None:
        by_time = np.argsort(amplitude.stamps, kind="stable")
        partner = by_time[nearest(amplitude.stamps[by_time], depth.stamps)]
        gap = np.abs(depth.stamps - amplitude.stamps[partner])
        if (gap > _SAME_IMAGE).all():
            raise CalibrationDataError(
                f"{origin}: no image of {amplitude.topic} is stamped within "
                f"{1000 * _SAME_IMAGE:.0f} ms of one of {depth.topic}; the nearest is "
                f"{gap.min():.3f} s away."
            )
        reason = f"{amplitude.topic} has no image of its time"
        refused = {names[k]: reason for k in order if gap[k] > _SAME_IMAGE}
        order = order[gap[order] <= _SAME_IMAGE]

    def counts(number: int) -> np.ndarray:
        return turned(depth.image(int(order[number])), coding.rotate)

    camera = camera_of(intrinsics, counts, len(order), origin)

    def read(number: int) -> DepthImage:
        place, beside = int(order[number]), None
        if amplitude is not None:
            beside = amplitude.image(int(partner[place])), amplitude.topic
        image = coded_image(coding, (depth.image(place), depth.topic), beside)
        return of_size(image, camera)

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
    beside = [str(space / "camera_info") for space in PurePosixPath(depth).parents]
    near = [topic for topic in beside if topic in found]
    if near or len(found) == 1:
        return (near or found)[0]
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
    model = str(message.distortion_model) or "none"
    values: dict[str, Any] = {"K": matrix, "distortion": lens, "distortion_model": model}
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
    found = "there is no such topic" if kind is None else f"it is {kind}"
    said = f"{option} {topic}: expected {' or '.join(wanted)}, {found}".replace("/msg/", "/")
    raise CalibrationDataError(f"{bag.path}: {said}. The topics: {bag.listed_topics()}.")


def _encoding(bag: Bag, topic: str) -> str:
    message = next((message for _, message in bag.messages(topic)), None)
    return str(getattr(message, "encoding", None) or getattr(message, "format", ""))


def _read_tf(bag: Bag) -> tuple[dict[str, str], dict[str, PoseTrack]]:
    """Read the parent of each frame, and its poses there: one without a time if it never moves.

    Raises:
        CalibrationDataError: There are none, one is not rigid, or a frame has two parents.
    """
    kinds = ("tf2_msgs/msg/TFMessage", "tf/msg/tfMessage")
    topics = [topic for topic, kind in bag.types.items() if kind in kinds]
    if not topics:
        raise CalibrationDataError(
            f"{bag.path}: no topic holds transforms (tf2_msgs/TFMessage); record /tf and "
            f"/tf_static. The topics: {bag.listed_topics()}."
        )
    parents: dict[str, str] = {}
    rows: dict[str, list[list[float]]] = {}
    moving: set[str] = set()
    for topic in topics:
        for _, message in bag.messages(topic):
            for one in message.transforms:
                parent, child = one.header.frame_id.lstrip("/"), one.child_frame_id.lstrip("/")
                if parents.setdefault(child, parent) != parent:
                    raise CalibrationDataError(
                        f"{bag.path}: tf gives the frame '{child}' two parents, "
                        f"'{parents[child]}' and '{parent}'."
                    )
                rows.setdefault(child, []).append(_row(one))
                # A frame that is published on both topics moves.
                moving |= set() if topic.rstrip("/").endswith("_static") else {child}
    tracks = {}
    for child, own in rows.items():
        name, values = f"{bag.path}: tf {parents[child]} -> {child}", np.array(own)
        poses = rigid_transforms(values[:, 1:4], values[:, 4:], lambda _, name=name: name)
        order = np.argsort(values[:, 0], kind="stable") if child in moving else [-1]
        times = values[order, 0] if child in moving else None
        tracks[child] = PoseTrack.checked(poses[order], name, times)
    return parents, tracks


def _row(message: Any) -> list[float]:  # noqa: ANN401 - of rosbags
    """Return the time of a transform, its translation, and its quaternion, scalar last."""
    move, turn = message.transform.translation, message.transform.rotation
    place = [getattr(move, axis) for axis in "xyz"]
    return [seconds(message.header.stamp), *place, *(getattr(turn, axis) for axis in "xyzw")]


def _base_from_tool(
    parents: dict[str, str], tracks: dict[str, PoseTrack], base: str, tool: str, source: str
) -> PoseTrack:
    """Return the poses of the tool in the base.

    Between the stamps of a frame its transform is interpolated; the result has the stamps of all
    moving frames on the way, as far as all of them are known.

    Args:
        parents: From `_read_tf`.
        tracks: From `_read_tf`.
        base: Name of the robot's base.
        tool: Name of its tool.
        source: The bag, for messages.

    Raises:
        CalibrationDataError: A frame is missing, they are not connected, or do not move.
    """
    up, down = _chain(parents, base, source), _chain(parents, tool, source)
    common = next((name for name in down if name in up), None)
    if common is None:
        raise CalibrationDataError(
            f"{source}: tf does not connect '{base}' (under '{up[-1]}') with '{tool}' (under "
            f"'{down[-1]}'). Is /tf_static recorded?"
        )
    to_tool = down[: down.index(common)][::-1]
    to_base = up[: up.index(common)][::-1]
    moving = [child for child in (*to_tool, *to_base) if tracks[child].timestamp is not None]
    if not moving:
        raise CalibrationDataError(
            f"{source}: every transform between '{base}' and '{tool}' is static; the tool does "
            "not move. Is --tool-frame the flange or the tool of the arm?"
        )
    # The stamps of all tracks within the time that all of them cover.
    stamps = [np.asarray(tracks[child].timestamp) for child in moving]
    times = np.unique(np.concatenate(stamps))
    first, last = max(time[0] for time in stamps), min(time[-1] for time in stamps)
    times = times[(times >= first) & (times <= last)]
    if not len(times):
        names = [f"tf {parents[child]} -> {child}" for child in moving[:2]]
        raise CalibrationDataError(f"{source}: {' and '.join(names)} share no time.")

    def product(children: Iterable[str]) -> torch.Tensor:
        whole = torch.eye(4, dtype=torch.float64).expand(len(times), 4, 4)
        for child in children:
            track = tracks[child]
            pose = track.at(times) if child in moving else track.world_from_tool[-1]
            whole = whole @ torch.from_numpy(pose)
        return whole

    poses = se3.inverse(product(to_base)) @ product(to_tool)
    return PoseTrack.checked(poses.numpy(), f"{source}: tf {base} -> {tool}", times)


def _chain(parents: dict[str, str], name: str, source: str) -> list[str]:
    """Return a frame and its ancestors, the root last."""
    known = {*parents, *parents.values()}
    if name not in known:
        listed = ", ".join(sorted(known)[:40])
        raise CalibrationDataError(f"{source}: tf has no frame '{name}'. Its frames: {listed}.")
    chain = [name]
    while (parent := parents.get(chain[-1])) is not None:
        if parent in chain:
            raise CalibrationDataError(f"{source}: tf goes round in a circle at '{parent}'.")
        chain.append(parent)
    return chain
