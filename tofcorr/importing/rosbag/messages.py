"""The messages of one topic by number, without holding them."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from tofcorr.errors import CalibrationDataError
from tofcorr.importing.rosbag.bag import Bag

_SKIPPED = 20
"""So many messages are read and dropped rather than looked up: as quick as a seek on a disk."""


class TopicMessages:
    """Access to the messages of a topic, quickest in the order they were recorded.

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
        self.topic = topic
        self._bag = Bag(path)
        self._iterator: Iterator[tuple[int, Any]] | None = None
        self._next = 0
        try:
            self._received, stamps, self.frame_id = self._scan()
        except BaseException:
            self.close()
            raise
        self.stamped = bool(stamps) and all(stamp > 0 for stamp in stamps)
        received = 1e-9 * np.array(self._received, dtype=np.float64)
        self.stamps = np.array(stamps) if self.stamped else received

    def __len__(self) -> int:
        """Return the number of messages."""
        return len(self._received)

    def _scan(self) -> tuple[list[int], list[float], str]:
        """Return times of receipt (nanoseconds), stamps (seconds), and the first frame's name."""
        received: list[int] = []
        stamps: list[float] = []
        frame_id = ""
        for time, message in self._bag.messages(self.topic):
            frame_id = frame_id or str(message.header.frame_id)
            received.append(time)
            stamps.append(message.header.stamp.sec + 1e-9 * message.header.stamp.nanosec)
        return received, stamps, frame_id

    def close(self) -> None:
        """Close the bag."""
        self._iterator = None
        self._bag.close()

    def read(self, number: int) -> Any:  # noqa: ANN401 - the type is the topic's
        """Return one message.

        Raises:
            CalibrationDataError: The bag cannot be read any more.
        """
        if self._iterator is None or not 0 <= number - self._next <= _SKIPPED:
            time = self._received[number]
            self._iterator = self._bag.messages(self.topic, start=time)
            # Several messages may have been received in one nanosecond.
            self._next = self._received.index(time)
        for _, message in self._iterator:
            self._next += 1
            if self._next == number + 1:
                return message
        raise CalibrationDataError(
            f"{self._bag.path}: message {number} of {self.topic} is gone. Was the bag changed?"
        )
