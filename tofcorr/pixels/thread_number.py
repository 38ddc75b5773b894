"""The number of threads that share an operation, for a while."""

from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from contextvars import ContextVar

import torch
from threadpoolctl import threadpool_limits

# Torch's number of threads outside the innermost `thread_number`; 0 outside of all.
_at_once: ContextVar[int] = ContextVar("threads at once", default=0)


@contextmanager
def thread_number(threads: int | None) -> Iterator[None]:
    """Let so many threads share an operation of torch, NumPy or SciPy, while a block runs.

    Threads that share a small operation wait for one another longer than they compute.

    Args:
        threads: How many; None: as many as the caller uses.
    """
    usual = torch.get_num_threads()
    before = _at_once.set(usual)
    if threads is not None:
        torch.set_num_threads(threads)
    try:
        with nullcontext() if threads is None else numpy_threads(threads):
            yield
    finally:
        torch.set_num_threads(usual)
        _at_once.reset(before)


def numpy_threads(threads: int) -> threadpool_limits:
    """Let so many threads share a matrix product of NumPy or SciPy while a block runs.

    Their library starts threads of its own beside those of torch and of Python. Products of several
    threads then wait for one another: `tofcorr.diagnose` took four times as long.

    Args:
        threads: How many.
    """
    return threadpool_limits(threads, user_api="blas")


def threads_at_once() -> int:
    """Return how many threads may compute different things at once: the caller's own number."""
    return _at_once.get() or torch.get_num_threads()
