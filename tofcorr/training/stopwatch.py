"""Where the time of a run went."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from time import perf_counter


class Stopwatch:
    """Adds up the seconds of named stages.

    Args:
        announce: Called with the name of each stage as it begins.

    Attributes:
        seconds: By stage, in the order of the first start, to the millisecond.
    """

    def __init__(self, announce: Callable[[str], object] = lambda name: None) -> None:
        self._announce = announce
        self.seconds: dict[str, float] = {}

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Add the time of the block to a stage, whatever ends it."""
        self._announce(name)
        start = perf_counter()
        try:
            yield
        finally:
            spent = self.seconds.get(name, 0.0) + perf_counter() - start
            self.seconds[name] = round(spent, 3)
