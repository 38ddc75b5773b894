"""What this process has begun to write, so that an interruption at any moment leaves none of it."""

from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

_BEGUN: dict[Path, Callable[[], object]] = {}


def begin(path: Path, undo: Callable[[], object]) -> None:
    """Note that something temporary is about to be made.

    Args:
        path: Its name, never used before.
        undo: Removes it; is called again if an interruption stopped the first call.
    """
    _BEGUN[path] = undo


def ended(path: Path) -> None:
    """Note that something temporary has been removed, or has its final name."""
    _BEGUN.pop(path, None)


def remove_begun() -> None:
    """Remove what an interruption kept from being removed.

    Python may raise `KeyboardInterrupt` between any two steps: before a block has begun that would
    tidy up, or while it does so. The program calls this when it has been stopped.
    """
    for path, undo in list(_BEGUN.items()):
        with suppress(OSError):
            undo()
        ended(path)
