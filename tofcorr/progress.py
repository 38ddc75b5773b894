"""How far long work has come: bars at a terminal, log lines for those who ask, TensorBoard's files.

A bar is drawn on standard error if, and only if, that is a terminal and no log lines were asked
for. In a log file nothing of it appears.
"""

import logging
import sys
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

if TYPE_CHECKING:
    from torch.utils.tensorboard import SummaryWriter

Item = TypeVar("Item")
Advance = Callable[[int], object]
"""Called with how many units were done since the last call."""

LOG = logging.getLogger("tofcorr")
"""Every step of long work is one line here, at level INFO."""


def log_to_stderr() -> None:
    """Write the log lines to standard error, and draw no bars between them."""
    handler = logging.StreamHandler()
    handler.setFormatter(logging.Formatter("%(relativeCreated)8.0f ms  %(message)s"))
    LOG.handlers[:] = [handler]
    LOG.setLevel(logging.INFO)


def drawn() -> bool:
    """Whether bars are drawn now."""
    return sys.stderr.isatty() and not LOG.isEnabledFor(logging.INFO)


@contextmanager
def bar(total: int, what: str, unit: str = "frame") -> Iterator[Advance]:
    """Show how many units of one kind of work are done.

    Args:
        total: How many there are.
        what: What is done, in a word or two.
        unit: What is counted.

    Yields:
        A function that takes the units done since its last call.
    """
    from tqdm import tqdm  # Slow to import; few commands need it.

    start = time.perf_counter()
    with tqdm(total=total, desc=what, unit=unit, leave=False, disable=not drawn()) as shown:
        yield shown.update
    LOG.info("%s: %d %ss in %.1f s", what, total, unit, time.perf_counter() - start)


def through(
    items: Iterable[Item], what: str, unit: str = "frame", total: int | None = None
) -> Iterator[Item]:
    """Yield the items, and show how many have passed.

    Args:
        items: What is worked on.
        what: What is done, in a word or two.
        unit: What is counted.
        total: How many there are; None: their length, 0 where they have none.
    """
    count = len(items) if total is None and hasattr(items, "__len__") else total or 0  # type: ignore[arg-type]
    with bar(count, what, unit) as advance:
        for item in items:
            yield item
            advance(1)


@contextmanager
def stages(what: str, total: int) -> Iterator[Callable[[str], None]]:
    """Show which of several stages work is in.

    Args:
        what: The work, in a word.
        total: How many stages there are.

    Yields:
        A function that is called with the name of each stage as it begins.
    """
    from tqdm import tqdm

    form = "{desc} {bar} {n_fmt}/{total_fmt} [{elapsed}]"
    with tqdm(total=total, leave=False, disable=not drawn(), bar_format=form) as shown:

        def begin(name: str) -> None:
            LOG.info("%s: %s", what, name)
            shown.set_description_str(f"{what}: {name}")
            shown.update(1)
            shown.refresh()

        yield begin


@contextmanager
def event_writer(folder: Path | str) -> Iterator["SummaryWriter"]:
    """Yield a writer of TensorBoard's files, whose thread prints no traceback when it fails.

    Args:
        folder: Where the event files go; made if it is missing.

    Raises:
        OSError: They could not be written, for example because the disk is full.
    """
    from torch.utils.tensorboard import SummaryWriter

    ended: list[BaseException | None] = []
    before = threading.excepthook
    threading.excepthook = keep = lambda arguments: ended.append(arguments.exc_value)
    try:
        with SummaryWriter(str(folder)) as writer:
            yield writer
    finally:
        if threading.excepthook is keep:
            threading.excepthook = before
    for error in ended:
        if error is not None:
            raise error
