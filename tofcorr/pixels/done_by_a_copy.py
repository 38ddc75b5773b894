"""A piece of work that a copy of this process does, while this one goes on."""

import os
import pickle
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cache
from multiprocessing import Pipe
from typing import TypeVar

from tofcorr.pixels.copied_process import copy_process, end_copy

Result = TypeVar("Result")


@contextmanager
def done_by_a_copy(work: Callable[[], Result], allowed: bool) -> Iterator[Callable[[], Result]]:
    """Let a copy of this process do a piece of work while a block runs.

    Where no copy can be made, the work is done before the block. Where the copy fails, for whatever
    reason, this process does the work when its result is asked for, or when the block fails: an
    error of the work may be why, and comes first.

    Args:
        work: Changes nothing and writes no file; its result can be pickled.
        allowed: False: there is no copy.

    Yields:
        What waits for the result and returns it.
    """
    here, there = Pipe()
    copy = copy_process((here, there)) if allowed else None
    if copy is None:
        result = work()
        yield lambda: result
        return
    if not copy:
        try:
            there.send_bytes(pickle.dumps(work(), protocol=pickle.HIGHEST_PROTOCOL))
        finally:
            os._exit(0)

    @cache
    def found() -> Result:
        try:
            message = here.recv_bytes()
        except (EOFError, OSError):
            return work()
        return pickle.loads(message)

    try:
        yield found
    except Exception:
        found()
        raise
    finally:
        here.close()
        end_copy(copy)
