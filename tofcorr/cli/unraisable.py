"""Ctrl-C that arrives where Python can raise nothing is delivered again a moment later."""

import signal
import sys
import threading
from _thread import interrupt_main
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from sys import UnraisableHookArgs

_LATER = 0.01
"""Seconds until an interruption is delivered again. Finalisers take microseconds. Chosen."""


@contextmanager
def no_interruption_lost() -> Iterator[None]:
    """Deliver an interruption again that Python dropped, for the length of the block.

    Python cannot raise out of finalisers and weak references: it prints a traceback, and the
    program goes on as if nobody had stopped it.
    """
    before = sys.unraisablehook

    def hook(problem: "UnraisableHookArgs") -> None:
        if not isinstance(problem.exc_value, KeyboardInterrupt):
            before(problem)
            return
        # Not at once: it would be raised in here, and be dropped again.
        # As SIGTERM, which nobody ignores: in the background of a shell Ctrl-C is.
        later = threading.Timer(_LATER, interrupt_main, (signal.SIGTERM,))
        later.daemon = True
        later.start()

    sys.unraisablehook = hook
    try:
        yield
    finally:
        sys.unraisablehook = before
