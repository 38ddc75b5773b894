"""The number of threads that share an operation, for a while."""

import sys
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from contextvars import ContextVar
from functools import lru_cache

import torch
from threadpoolctl import ThreadpoolController

# Torch's number of threads outside the innermost `thread_number`; 0 outside of all.
_at_once: ContextVar[int] = ContextVar("threads at once", default=0)
# Modules that bring a library of matrix products of their own; NumPy's is always there.
_WITH_PRODUCTS = ("scipy.linalg._fblas", "cv2")


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


def one_thread() -> AbstractContextManager[None]:
    """Let one thread do each operation while a block of small ones runs.

    Where one does already nothing changes: `threads_at_once` stays what it is.
    """
    return thread_number(1) if torch.get_num_threads() > 1 else nullcontext()


def numpy_threads(threads: int) -> AbstractContextManager[object]:
    """Let so many threads share a matrix product of NumPy or SciPy while a block runs.

    Their library starts threads of its own beside those of torch and of Python. Products of several
    threads then wait for one another: `tofcorr.diagnose` took four times as long.

    Args:
        threads: How many.
    """
    loaded = tuple(name for name in _WITH_PRODUCTS if name in sys.modules)
    return _libraries(loaded).limit(limits=threads, user_api="blas")


@lru_cache(maxsize=1)
def _libraries(loaded: tuple[str, ...]) -> ThreadpoolController:
    """Find the libraries when these modules were loaded; looking for them takes milliseconds."""
    del loaded
    return ThreadpoolController()


def threads_at_once() -> int:
    """Return how many threads may compute different things at once: the caller's own number."""
    return _at_once.get() or torch.get_num_threads()
