"""Ctrl-C ends a fit early instead of losing it."""

import signal
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType


@contextmanager
def interruptible() -> Iterator[list[int]]:
    """Collect Ctrl-C instead of raising KeyboardInterrupt, for the length of the block.

    Outside the main thread Python allows no handler: interruptions then reach the caller as usual.

    Yields:
        The signals received so far; empty until Ctrl-C is pressed.
    """
    received: list[int] = []

    def note(number: int, _: FrameType | None) -> None:
        received.append(number)

    try:
        before = signal.signal(signal.SIGINT, note)
    except ValueError:
        yield received
        return
    try:
        yield received
    finally:
        signal.signal(signal.SIGINT, before)
