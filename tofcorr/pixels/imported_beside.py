"""Modules that later steps need, imported by a thread of its own beside the first ones."""

import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from importlib import import_module
from threading import Thread

from tofcorr.pixels.thread_number import threads_at_once

# How long one thread of Python may keep another one waiting, seconds. An import keeps the
# interpreter for itself, while an operation of torch gives it away and wants it back. Chosen: as
# long as an operation on all pixels takes; with Python's own 5 ms every one of them waited longer.
_TURN = 5e-4


@contextmanager
def imported_beside(names: Sequence[str], allowed: bool) -> Iterator[None]:
    """Import modules while the block runs, where a second core is free; its end waits for them.

    What cannot be imported is left to the step that needs it.

    Args:
        names: Of the modules. Where two of them need a third one that the block may import too, the
            one with the shorter way to it comes first: threads that wait for one another's modules
            get unfinished ones.
        allowed: False: nothing is imported.
    """
    if not allowed or threads_at_once() < 2:
        yield
        return
    thread = Thread(target=_import_all, args=(names,))
    before = sys.getswitchinterval()
    sys.setswitchinterval(_TURN)
    thread.start()
    try:
        yield
    finally:
        thread.join()
        sys.setswitchinterval(before)


def _import_all(names: Sequence[str]) -> None:
    for name in names:
        with suppress(ImportError):
            import_module(name)
