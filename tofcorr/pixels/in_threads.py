"""Work on successive items by several threads, each of which computes alone."""

from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from typing import TypeVar

import torch

from tofcorr.pixels.thread_number import numpy_threads

Item = TypeVar("Item")
Result = TypeVar("Result")


def in_threads(
    work: Callable[[Item], Result], items: Iterable[Item], threads: int | None = None
) -> Iterator[Result]:
    """Yield `work` of every item, in order.

    Threads that share each small operation wait for one another several thousand times a second.
    Here each thread takes a whole item, and torch and NumPy compute it alone; so does the caller's
    between items. Only a few items more than threads are read ahead.

    Args:
        work: May be called by several threads at once; its result must not depend on the order.
        items: Read by the caller's thread.
        threads: How many; None: as many as torch uses.
    """
    usual = torch.get_num_threads()
    threads = usual if threads is None else threads
    if threads < 2:
        yield from map(work, items)
        return
    gradients = torch.is_grad_enabled()

    def alone(item: Item) -> Result:
        torch.set_num_threads(1)
        with torch.set_grad_enabled(gradients):
            return work(item)

    waiting: deque[Future[Result]] = deque()
    with ThreadPoolExecutor(threads) as pool, numpy_threads(1):
        try:
            # The helpers of the caller's own operations would spin beside the pool.
            torch.set_num_threads(1)
            for item in items:
                waiting.append(pool.submit(alone, item))
                if len(waiting) > threads:
                    yield waiting.popleft().result()
            while waiting:
                yield waiting.popleft().result()
        finally:
            for future in waiting:
                future.cancel()
            pool.shutdown()
            torch.set_num_threads(usual)
