"""The number of threads that share an operation, for a while."""

from collections.abc import Iterator
from contextlib import contextmanager

import torch


@contextmanager
def thread_number(threads: int | None) -> Iterator[None]:
    """Let so many threads share an operation of torch; the caller's own number stands again after.

    Threads that share a small operation wait for one another longer than they compute.

    Args:
        threads: How many; None: as many as the caller uses.
    """
    usual = torch.get_num_threads()
    if threads is not None:
        torch.set_num_threads(threads)
    try:
        yield
    finally:
        torch.set_num_threads(usual)
