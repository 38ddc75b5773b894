"""A bag's images, camera, and the robot's transforms from base to tool, ready to be imported.

Everything that the package `rosbags` raises on a damaged file becomes one sentence.
"""

import math
from collections.abc import Iterable, Iterator
from contextlib import ExitStack, closing, contextmanager
from itertools import islice
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
import torch

from tofcorr.data.table import rigid_transforms
from tofcorr.errors import CalibrationDataError, ConfigError, TofcorrError
from tofcorr.files import open_regular
from tofcorr.geometry import se3
from tofcorr.importing.images import DepthCoding, DepthImage, coded_image, decoded
from tofcorr.importing.intrinsics import (
    GivenIntrinsics,
    intrinsics_from_mapping,
    read_named_intrinsics,
)
from tofcorr.importing.pose_track import PoseTrack, nearest
from tofcorr.importing.robot_images import RobotImages
from tofcorr.importing.rosbag.growing import files_so_far
from tofcorr.importing.run import Refused, RefusedViewError

_IMAGES = ("sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage")
_CAMERA_INFO = "sensor_msgs/msg/CameraInfo"

_TYPES = {"16UC1": "u2", "mono16": "u2", "32FC1": "f4", "64FC1": "f8", "32SC1": "i4"}
"""Number type of each encoding of one channel. Eight bits are a preview."""

_DEPTH_HEADER = 12
"""Bytes before the PNG of compressedDepth: its format, and two numbers that code depth in floats
(image_transport_plugins, compressed_depth_image_transport)."""


class Bag:
    """An open bag: a ROS 1 file, a ROS 2 folder, or an MCAP or SQLite file of ROS 2.

    Attributes:
        path: The file or folder.
        reader: An `AnyReader` of rosbags.
    """

    def __init__(self, path: Path, reader: Any) -> None:  # noqa: ANN401 - of rosbags
        self.path, self.reader = path, reader

    @property
    def types(self) -> dict[str, str]:
        """The message type of each topic, by its name, such as `sensor_msgs/msg/Image`."""
        return {c.topic: c.msgtype for c in self.reader.connections}

    def messages(self, topic: str, start: int | None = None) -> Iterator[tuple[int, Any]]:
        """Yield the messages of a topic with the times they were received at, nanoseconds.

        Args:
            topic: Its name.
            start: Messages received before are left out, nanoseconds.
        """
        own = [c for c in self.reader.connections if c.topic == topic]
        with damage_reported(self.path):
            for connection, received, content in self.reader.messages(own, start=start):
                yield received, self.reader.deserialize(content, connection.msgtype)

    def first(self, topic: str) -> Any:  # noqa: ANN401 - the type is the topic's
        """Return the first message of a topic.

        Raises:
            CalibrationDataError: There is none.
        """
        for _, message in self.messages(topic):
            return message
        raise CalibrationDataError(f"{self.path}: {topic} has no message.")

    def listed_topics(self) -> str:
        """Return the topics and their types, for messages."""
        listed = [f"{topic} ({kind.replace('/msg/', '/')})" for topic, kind in self.types.items()]
        return ", ".join(sorted(listed)) or "none"


@contextmanager
def _opened(path: Path, *, grows: bool = False) -> Iterator[Bag]:
    """Open a bag.

    Args:
        path: The file or folder.
        grows: Whether it may be one that is still being written, which is read as far as it goes.

    Raises:
        CalibrationDataError: It is no bag, is damaged, or the package `rosbags` is missing.
    """
    if not path.exists():
        raise CalibrationDataError(f"{path}: there is no such bag.")
    try:
        from rosbags import highlevel
        from rosbags.typesys import Stores, get_typestore
    except ImportError:
        raise CalibrationDataError(f"{path} needs rosbags: pip install 'tofcorr[rosbag]'") from None
    with damage_reported(path):
        for file in path.iterdir() if path.is_dir() else [path]:
            open_regular(file, math.inf).close()
        # The message types of bags that do not hold their own.
        default = get_typestore(Stores.ROS2_HUMBLE)
        paths = files_so_far(path) if grows else [path]
        reader = highlevel.AnyReader(paths, default_typestore=default)
        reader.open()
    with closing(reader):
        yield Bag(path, reader)


@contextmanager
def damage_reported(path: Path) -> Iterator[None]:
    """Turn what a reader raises on damaged bytes into one sentence."""
    try:
        yield
    except TofcorrError:
        raise
    except Exception as error:  # noqa: BLE001 - the reader raises whatever its bytes lead it to
        detail = f"{type(error).__name__}: {error}".splitlines()[0][:150]
        raise CalibrationDataError(f"{path}: not a readable ROS bag ({detail}).") from None


def seconds(stamp: Any) -> float:  # noqa: ANN401 - of rosbags
    """Return a time stamp in seconds."""
    return stamp.sec + stamp.nanosec / 10**9


class TopicMessages:
    """Access to the messages of a topic by number, quickest in the order they were recorded.

    Args:
        bag: An open bag that nothing else is read from meanwhile.
        topic: The topic.

    Attributes:
        bag, topic: As given.
        stamps: Times in the messages' headers, shape (N,), seconds; of receipt where headers hold
            none.
        stamped: Whether headers hold times.
        frame_id: The coordinate frame that the first header names; empty if none.
    """

    def __init__(self, bag: Bag, topic: str) -> None:
        self.bag, self.topic, self.frame_id = bag, topic, ""
        self._iterator: Iterator[tuple[int, Any]] | None = None
        self._next, self._received = 0, list[int]()
        stamps: list[float] = []
        for time, message in bag.messages(topic):
            self.frame_id = self.frame_id or str(message.header.frame_id)
            self._received.append(time)
            stamps.append(seconds(message.header.stamp))
        self.stamped = bool(stamps) and all(stamp > 0 for stamp in stamps)
        received = np.array(self._received, dtype=np.float64) / 10**9
        self.stamps = np.array(stamps) if self.stamped else received

    def image(self, number: int) -> np.ndarray:
        """Return a message of type Image or CompressedImage as an array, shape (H, W).

        Raises:
            RefusedViewError: It is damaged, has several channels, or is coded with losses.
            CalibrationDataError: The bag cannot be read any more.
        """
        # To read and drop 20 messages is as quick as a seek on a disk.
        if self._iterator is None or not 0 <= number - self._next <= 20:
            time = self._received[number]
            self._iterator = self.bag.messages(self.topic, start=time)
            # Several messages may have been received in one nanosecond.
            self._next = self._received.index(time)
        message = next((one for _, one in islice(self._iterator, number - self._next, None)), None)
        self._next = number + 1
        if message is None:
            raise CalibrationDataError(f"{self.bag.path}: lost message {number} of {self.topic}.")
        if hasattr(message, "encoding"):
            return _plain(message, self.topic)
        return _compressed(str(message.format), bytes(message.data), self.topic)


def _plain(message: Any, topic: str) -> np.ndarray:  # noqa: ANN401 - of rosbags
    kind = _TYPES.get(message.encoding)
    if kind is None:
        known = f"one channel of 16 bits or more: {', '.join(_TYPES)}"
        raise RefusedViewError(f"{topic} has encoding '{message.encoding[:40]}'; expected {known}")
    height, width, step = int(message.height), int(message.width), int(message.step)
    row = width * np.dtype(kind).itemsize
    if not height or not width or step < row or len(message.data) < height * step:
        size = f"{width}x{height} pixels with {step} bytes a row"
        raise RefusedViewError(f"{topic}: {len(message.data)} bytes do not hold {size}")
    content = np.asarray(message.data, dtype=np.uint8)[: height * step].reshape(height, step)
    order = ">" if message.is_bigendian else "<"
    return np.ascontiguousarray(content[:, :row]).view(order + kind).astype(kind)


def _compressed(coding: str, content: bytes, topic: str) -> np.ndarray:
    """Undo compression; compressedDepth is a PNG of counts, or of inverse depth for floats."""
    of_depth, lossy = "compressedDepth" in coding, "jpeg" in coding or "jpg" in coding
    if "rvl" in coding.lower() or (lossy and not of_depth):
        raise RefusedViewError(f"{topic} is coded as '{coding[:60]}'; record it raw or as PNG")
    image = decoded(content[_DEPTH_HEADER:] if of_depth else content)
    if image is None or image.ndim != 2:
        raise RefusedViewError(f"{topic}: a compressed image cannot be decoded to one channel")
    if not of_depth or not coding.strip().startswith("32FC1"):
        return image
    scale, shift = np.frombuffer(content[4:_DEPTH_HEADER], dtype="<f4").astype(np.float64)
    counts = image.astype(np.float64)
    with np.errstate(divide="ignore", invalid="ignore"):
        depth = np.where(counts > 0, scale / (counts - shift), np.nan)
    return depth.astype(np.float32)


@contextmanager
def open_bag(  # noqa: PLR0913 - a bag has many topics
    path: Path,
    depth_topic: str,
    coding: DepthCoding,
    *,
    base_frame: str,
    tool_frame: str,
    amplitude_topic: str | None = None,
    camera_info: str | None = None,
    intrinsics: str | None = None,
    grows: bool = False,
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
        grows: Whether the bag may be one that is still being written.

    Yields:
        The images, to be read before the block ends, and the poses of the tool in the base.

    Raises:
        CalibrationDataError: The bag is damaged, or lacks something; the message says what.
        ConfigError: Intrinsics are named twice.
    """
    if camera_info is not None and intrinsics is not None:
        raise ConfigError("name the intrinsics once: --camera-info or --intrinsics.")
    with ExitStack() as opened:
        bag, warnings = opened.enter_context(_opened(path, grows=grows)), list[str]()
        with damage_reported(path):
            for named, option in ((depth_topic, "--depth"), (amplitude_topic, "--amplitude")):
                if named is not None:
                    _check(bag, named, option, _IMAGES)
                    bag.first(named)
            if intrinsics is not None:
                given = read_named_intrinsics(intrinsics)
            else:
                topic = _camera_info_topic(bag, depth_topic, camera_info)
                given, warnings = _read_camera_info(bag, topic, depth_topic)
            frames = base_frame.lstrip("/"), tool_frame.lstrip("/")
            track = _base_from_tool(*_read_tf(bag), *frames, str(path))
            depth, amplitude = TopicMessages(bag, depth_topic), None
            if amplitude_topic is not None:
                # Of its own, so that two topics can be read in turn.
                own = opened.enter_context(_opened(path, grows=grows))
                amplitude = TopicMessages(own, amplitude_topic)
            if not depth.stamped:
                said = f"The headers of {depth.topic} hold no time stamps"
                warnings.append(f"{said}; the times of receipt are used.")
            # In the order of their times.
            order = np.argsort(depth.stamps, kind="stable")
            names = [f"{stamp:.6f}" for stamp in depth.stamps]
            refused, partner = Refused(), order
            if amplitude is not None:
                partner, alone = _partners(depth, amplitude)
                reason = f"{amplitude.topic} has no image of its time"
                refused = {names[k]: reason for k in order if alone[k]}
                order = order[~alone[order]]

        def read(number: int) -> DepthImage:
            place, beside = int(order[number]), None
            if amplitude is not None:
                beside = amplitude.image(int(partner[place])), amplitude.topic
            return coded_image(coding, (depth.image(place), depth.topic), beside)

        yield RobotImages(
            origin=str(path),
            names=[names[k] for k in order],
            intrinsics=given,
            read=read,
            track=track,
            times=depth.stamps[order],
            refused=refused,
            warnings=warnings,
            camera_frame=depth.frame_id.lstrip("/"),
        )


def _partners(depth: TopicMessages, amplitude: TopicMessages) -> tuple[np.ndarray, np.ndarray]:
    """Return the amplitude image nearest in time to each of depth, and which depth has none.

    One of the same exposure is within a third of the time between images; most drivers give both
    one stamp.

    Raises:
        CalibrationDataError: None is of the time of any.
    """
    by_time = np.argsort(amplitude.stamps, kind="stable")
    partner = by_time[nearest(amplitude.stamps[by_time], depth.stamps)]
    gap = np.abs(depth.stamps - amplitude.stamps[partner])
    alone = 3 * gap > np.median(np.diff(np.sort(depth.stamps))) if len(gap) > 1 else gap > 0
    if alone.all():
        said = f"no image of {amplitude.topic} is near one of {depth.topic}"
        raise CalibrationDataError(f"{depth.bag.path}: {said}, to {gap.min():.3f} s at best.")
    return partner, alone


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
    said = many if found else "no topic holds camera intrinsics (CameraInfo)"
    raise CalibrationDataError(f"{bag.path}: {said}. Name --camera-info or --intrinsics.")


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
        raise CalibrationDataError(f"{bag.path}: {topic} holds K of zeros. Name --intrinsics.")
    model = str(message.distortion_model) or "none"
    values: dict[str, Any] = {"K": matrix, "distortion": lens, "distortion_model": model}
    if message.width and message.height:
        values |= {"width": int(message.width), "height": int(message.height)}
    warnings = []
    if "image_rect" in depth and any(lens):
        matrix = [*projection[:3], *projection[4:7], *projection[8:11]]
        values |= {"K": matrix, "distortion": []}
        used = f"{depth} is undistorted by its name: the projection P of {topic} is used"
        warnings.append(f"{used}. State --intrinsics if that is wrong.")
    return intrinsics_from_mapping(values, f"{bag.path}: {topic}"), warnings


def _check(bag: Bag, topic: str, option: str, wanted: tuple[str, ...]) -> None:
    kind = bag.types.get(topic)
    if kind not in wanted:
        found = "there is no such topic" if kind is None else f"it is {kind}"
        said = f"{option} {topic}: expected {' or '.join(wanted)}, {found}".replace("/msg/", "/")
        raise CalibrationDataError(f"{bag.path}: {said}. The topics: {bag.listed_topics()}.")


def _read_tf(bag: Bag) -> tuple[dict[str, str], dict[str, PoseTrack]]:
    """Read the parent of each frame, and its poses there: one without a time if it never moves.

    Raises:
        CalibrationDataError: There are none, one is not rigid, or a frame has two parents.
    """
    kinds = ("tf2_msgs/msg/TFMessage", "tf/msg/tfMessage")
    topics = [topic for topic, kind in bag.types.items() if kind in kinds]
    if not topics:
        topics = bag.listed_topics()
        raise CalibrationDataError(f"{bag.path}: no topic holds transforms. The topics: {topics}.")
    parents: dict[str, str] = {}
    rows: dict[str, list[list[float]]] = {}
    moving: set[str] = set()
    for topic in topics:
        for _, message in bag.messages(topic):
            for one in message.transforms:
                parent, child = one.header.frame_id.lstrip("/"), one.child_frame_id.lstrip("/")
                if parents.setdefault(child, parent) != parent:
                    two = f"'{parents[child]}' and '{parent}'"
                    raise CalibrationDataError(f"{bag.path}: tf: '{child}' has parents {two}.")
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
    if up[-1] != down[-1]:
        roots = f"'{base}' (under '{up[-1]}') with '{tool}' (under '{down[-1]}')"
        raise CalibrationDataError(f"{source}: tf does not connect {roots}. Record /tf_static?")
    to_tool, to_base = (
        [c for c in one[::-1] if c not in two] for one, two in ((down, up), (up, down))
    )
    moving = [child for child in (*to_tool, *to_base) if tracks[child].timestamp is not None]
    if not moving:
        raise CalibrationDataError(f"{source}: '{tool}' is static in '{base}': name --tool-frame.")
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
            whole = whole @ torch.from_numpy(tracks[child].at(times))
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
