"""A ROS bag of either version, opened for one topic at a time.

Everything that the package `rosbags` raises on a damaged file becomes one sentence.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from tofcorr.errors import CalibrationDataError, TofcorrError


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
        highlevel, default = _rosbags(path)
        with damage_reported(path):
            self._reader: Any = highlevel.AnyReader([path], default_typestore=default)
            self._reader.open()
            self.types: dict[str, str] = {
                connection.topic: connection.msgtype for connection in self._reader.connections
            }

    def close(self) -> None:
        """Close the files; closing twice does nothing."""
        reader, self._reader = self._reader, None
        if reader is not None:
            with damage_reported(self.path):
                reader.close()

    def count(self, topic: str) -> int:
        """Return how many messages a topic has."""
        own = [c for c in self._reader.connections if c.topic == topic]
        return sum(connection.msgcount for connection in own)

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


def _rosbags(path: Path) -> tuple[Any, Any]:
    """Import the reader, and the message types of bags that do not hold their own."""
    try:
        from rosbags import highlevel
        from rosbags.typesys import Stores, get_typestore
    except ImportError:
        raise CalibrationDataError(
            f"{path}: reading bags needs the package rosbags: pip install 'tofcorr[rosbag]'"
        ) from None
    return highlevel, get_typestore(Stores.ROS2_HUMBLE)
