"""Threads: how many share an operation, and work on successive items by several at once."""

from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager, nullcontext
from contextvars import ContextVar
from typing import TypeVar

import torch
from threadpoolctl import threadpool_limits

Item = TypeVar("Item")
Result = TypeVar("Result")

# Torch's number of threads outside the outermost `thread_number`; 0 outside of all.
_at_once: ContextVar[int] = ContextVar("threads at once", default=0)


@contextmanager
def thread_number(threads: int | None) -> Iterator[None]:
    """Let so many threads share an operation of torch, NumPy or SciPy, while a block runs.

    Threads that share a small operation wait for one another longer than they compute; with matrix
    products of several threads a diagnosis took four times as long.

    Args:
        threads: How many; None: as many as the caller uses.
    """
    usual = torch.get_num_threads()
    before = _at_once.set(threads_at_once())
    if threads is not None:
        torch.set_num_threads(threads)
    try:
        with nullcontext() if threads is None else threadpool_limits(threads, user_api="blas"):
            yield
    finally:
        torch.set_num_threads(usual)  # Last: a limit on products may set it too.
        _at_once.reset(before)


def threads_at_once() -> int:
    """Return how many threads may compute different things at once: the caller's own number."""
    return _at_once.get() or torch.get_num_threads()


def in_threads(
    work: Callable[[Item], Result], items: Iterable[Item], threads: int | None = None
) -> Iterator[Result]:
    """Yield `work` of every item, in order; each thread takes a whole item and computes it alone.

    Args:
        work: May be called by several threads at once; its result must not depend on the order.
        items: Read by the caller's thread, only a few more than there are threads ahead.
        threads: How many; None: as many as the caller uses.
    """
    threads = threads_at_once() if threads is None else threads
    if threads < 2:
        yield from map(work, items)
        return
    gradients = torch.is_grad_enabled()

    def alone(item: Item) -> Result:
        torch.set_num_threads(1)
        with torch.set_grad_enabled(gradients):
            return work(item)

    waiting: deque[Future[Result]] = deque()
    with thread_number(1), ThreadPoolExecutor(threads) as pool:
        for item in items:
            waiting.append(pool.submit(alone, item))
            if len(waiting) > threads:
                yield waiting.popleft().result()
        while waiting:
            yield waiting.popleft().result()
