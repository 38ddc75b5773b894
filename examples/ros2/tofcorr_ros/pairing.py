"""Depth and infrared images of one exposure, found by their stamps in whatever order they come."""

from sensor_msgs.msg import Image

# How many images of either kind wait for their partner: a third of a second at 30 Hz.
_WAITING = 10


class StampPairs:
    """Pairs messages of two topics whose stamps agree.

    Args:
        tolerance: Largest difference of the stamps, seconds.
    """

    def __init__(self, tolerance: float) -> None:
        self.tolerance = tolerance
        self._waiting: dict[str, list[Image]] = {"depth": [], "infrared": []}

    def add(self, kind: str, message: Image) -> tuple[Image, Image] | None:
        """Return depth and infrared once both are there; None while one is missing.

        Args:
            kind: `depth` or `infrared`.
            message: Its header has the stamp.
        """
        other = "infrared" if kind == "depth" else "depth"
        partners = self._waiting[other]
        if partners:
            apart = [abs(_seconds(message) - _seconds(one)) for one in partners]
            k = apart.index(min(apart))
            if apart[k] <= self.tolerance:
                partner = partners[k]
                del partners[: k + 1]
                self._waiting[kind].clear()
                return (message, partner) if kind == "depth" else (partner, message)
        self._waiting[kind] = [*self._waiting[kind], message][-_WAITING:]
        return None


def _seconds(message: Image) -> float:
    stamp = message.header.stamp
    return stamp.sec + 1e-9 * stamp.nanosec
