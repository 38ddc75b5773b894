"""A ROS bag of either version: its topics, the messages of one by number, and images as arrays.

Everything that the package `rosbags` raises on a damaged file becomes one sentence.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np

from tofcorr.errors import CalibrationDataError, TofcorrError
from tofcorr.importing.images import decoded
from tofcorr.importing.run import RefusedViewError

_TYPES = {
    "16UC1": np.uint16,
    "mono16": np.uint16,
    "32FC1": np.float32,
    "64FC1": np.float64,
    "32SC1": np.int32,
    "mono8": np.uint8,
    "8UC1": np.uint8,
}
"""Number type of each encoding of one channel."""

_DEPTH_HEADER = 12
"""Bytes before the PNG of compressedDepth: its format, and two numbers that code depth in floats
(image_transport_plugins, compressed_depth_image_transport)."""


class Bag:
    """An open bag: a ROS 1 file, a ROS 2 folder, or an MCAP or SQLite file of ROS 2.

    Args:
        path: The file or folder.

    Attributes:
        path: The file or folder.
        types: The message type of each topic, by its name, such as `sensor_msgs/msg/Image`.

    Raises:
        CalibrationDataError: It is no bag, is damaged, or the package `rosbags` is missing.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        if not path.exists():
            raise CalibrationDataError(f"{path}: there is no such bag.")
        try:
            from rosbags import highlevel
            from rosbags.typesys import Stores, get_typestore
        except ImportError:
            raise CalibrationDataError(
                f"{path}: reading bags needs the package rosbags: pip install 'tofcorr[rosbag]'"
            ) from None
        with damage_reported(path):
            # The message types of bags that do not hold their own.
            default = get_typestore(Stores.ROS2_HUMBLE)
            self._reader: Any = highlevel.AnyReader([path], default_typestore=default)
            self._reader.open()
            self.types: dict[str, str] = {c.topic: c.msgtype for c in self._reader.connections}

    def close(self) -> None:
        """Close the files; closing twice does nothing."""
        reader, self._reader = self._reader, None
        if reader is not None:
            with damage_reported(self.path):
                reader.close()

    def messages(self, topic: str, start: int | None = None) -> Iterator[tuple[int, Any]]:
        """Yield the messages of a topic with the times they were received at, nanoseconds.

        Args:
            topic: Its name.
            start: Messages received before are left out, nanoseconds.
        """
        own = [c for c in self._reader.connections if c.topic == topic]
        with damage_reported(self.path):
            for connection, received, content in self._reader.messages(own, start=start):
                yield received, self._reader.deserialize(content, connection.msgtype)

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
def damage_reported(path: Path) -> Iterator[None]:
    """Turn what a reader raises on damaged bytes into one sentence."""
    try:
        yield
    except TofcorrError:
        raise
    except Exception as error:  # noqa: BLE001 - the reader raises whatever its bytes lead it to
        detail = (str(error).splitlines() or [""])[0][:150]
        raise CalibrationDataError(
            f"{path}: not a readable ROS bag; is it damaged or still being written? "
            f"({type(error).__name__}{': ' if detail else ''}{detail})"
        ) from None


def seconds(stamp: Any) -> float:  # noqa: ANN401 - of rosbags
    """Return a time stamp in seconds."""
    return stamp.sec + stamp.nanosec / 10**9


class TopicMessages:
    """Access to the messages of a topic by number, quickest in the order they were recorded.

    Args:
        path: The bag; it is opened a second time, so that two topics can be read in turn.
        topic: The topic.

    Attributes:
        topic: Its name.
        stamps: Times in the messages' headers, shape (N,), seconds; of receipt where headers hold
            none.
        stamped: Whether headers hold times.
        frame_id: The coordinate frame that the first header names; empty if none.
    """

    def __init__(self, path: Path, topic: str) -> None:
        self.topic, self.frame_id = topic, ""
        self._bag = Bag(path)
        self._iterator: Iterator[tuple[int, Any]] | None = None
        self._next, self._received = 0, list[int]()
        stamps: list[float] = []
        try:
            for time, message in self._bag.messages(topic):
                self.frame_id = self.frame_id or str(message.header.frame_id)
                self._received.append(time)
                stamps.append(seconds(message.header.stamp))
        except BaseException:
            self.close()
            raise
        self.stamped = bool(stamps) and all(stamp > 0 for stamp in stamps)
        received = np.array(self._received, dtype=np.float64) / 10**9
        self.stamps = np.array(stamps) if self.stamped else received

    def close(self) -> None:
        """Close the bag."""
        self._iterator = None
        self._bag.close()

    def image(self, number: int) -> np.ndarray:
        """Return a message of type Image or CompressedImage as an array, shape (H, W).

        Raises:
            RefusedViewError: It is damaged, has several channels, or is coded with losses.
            CalibrationDataError: The bag cannot be read any more.
        """
        # To read and drop 20 messages is as quick as a seek on a disk.
        if self._iterator is None or not 0 <= number - self._next <= 20:
            time = self._received[number]
            self._iterator = self._bag.messages(self.topic, start=time)
            # Several messages may have been received in one nanosecond.
            self._next = self._received.index(time)
        message = next((one for _, one in islice(self._iterator, number - self._next, None)), None)
        self._next = number + 1
        if message is None:
            raise CalibrationDataError(
                f"{self._bag.path}: message {number} of {self.topic} is gone. Was the bag changed?"
            )
        if hasattr(message, "encoding"):
            return _plain(message, self.topic)
        return _compressed(str(message.format), bytes(message.data), self.topic)


def _plain(message: Any, topic: str) -> np.ndarray:  # noqa: ANN401 - of rosbags
    kind = _TYPES.get(message.encoding)
    if kind is None:
        raise RefusedViewError(
            f"{topic} has the encoding '{message.encoding[:40]}'; expected one channel: "
            f"{', '.join(_TYPES)}"
        )
    height, width, step = int(message.height), int(message.width), int(message.step)
    row = width * np.dtype(kind).itemsize
    if not height or not width or step < row or len(message.data) < height * step:
        raise RefusedViewError(
            f"{topic}: {len(message.data)} bytes do not hold {width}x{height} pixels of "
            f"{message.encoding} with {step} bytes a row"
        )
    content = np.asarray(message.data, dtype=np.uint8)[: height * step].reshape(height, step)
    order = ">" if message.is_bigendian else "<"
    image = np.ascontiguousarray(content[:, :row]).view(np.dtype(kind).newbyteorder(order))
    return image.astype(kind)


def _compressed(coding: str, content: bytes, topic: str) -> np.ndarray:
    """Undo compression; compressedDepth is a PNG of counts, or of inverse depth for floats."""
    of_depth = "compressedDepth" in coding
    if of_depth and "rvl" in coding.lower():
        raise RefusedViewError(
            f"{topic} is coded as RVL ('{coding[:60]}'); expected PNG. Republish it as raw"
        )
    if not of_depth and ("jpeg" in coding or "jpg" in coding):
        raise RefusedViewError(
            f"{topic} holds JPEG images ('{coding[:60]}'): 8 bits a pixel, with losses. Record the "
            "raw topic, or compressedDepth"
        )
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
