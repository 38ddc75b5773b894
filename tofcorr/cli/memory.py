"""How the program's memory is managed: set once, before a command runs."""

import atexit
import ctypes
import gc
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from threading import Event, Thread

# Numbers of three parameters of `mallopt`. Derived: those of malloc.h in glibc.
_M_TRIM_THRESHOLD, _M_MMAP_MAX, _M_ARENA_MAX = -1, -4, -8
# Freed memory at the end of the heap that is kept for the next tensor, bytes. Chosen: more than a
# diagnosis frees at once, so that its memory is cleared once.
_KEPT_BYTES = 1024**3
# Numbers of the advice to hand out large pages, and to hand memory out before it is used: those of
# linux/mman.h.
_MADV_HUGEPAGE, _MADV_POPULATE_WRITE = 14, 23
# Bytes that the kernel hands out at a time, and where they begin: at a multiple of this. Chosen:
# two large pages; nothing else of the program can ask for memory meanwhile.
_AT_ONCE = 4 * 1024**2
# Net number of new containers that starts a search for unreachable ones. Python's own 700 starts
# 703 searches while `tofcorr diagnose` is imported, a seventh of the time that takes. Measured.
_NEW_CONTAINERS = 10_000
# So many are there before the first search, and none of them is ever searched. Chosen: what a
# command imports has 340,000, and searches of every 10,000 took 0.1 s while it was imported.
_OF_IMPORTS = 300_000


def set_up_memory() -> None:
    """Search for unreachable objects less often, and not when the program ends.

    The last search, through all that torch has made, took half a second.

    It is for a program that runs one command and ends. `import tofcorr` sets nothing.
    """
    gc.set_threshold(_OF_IMPORTS)
    gc.callbacks.append(_leave_out_imports)
    atexit.register(gc.freeze)


def _leave_out_imports(phase: str, _: object) -> None:
    """Leave out of all searches what is there when the first one starts."""
    if phase == "start":
        gc.freeze()
        gc.set_threshold(_NEW_CONTAINERS)
        gc.callbacks.remove(_leave_out_imports)


def keep_freed_memory(platform: str = sys.platform) -> bool:
    """Tell the C library to keep what is freed; return whether it could be told.

    The C library of Linux otherwise gives every large tensor back to the kernel when it is freed.
    The kernel then clears the same memory for the next one, page by page, which takes longer than
    the arithmetic: a tensor of 80 MB and its double took 0.08 s in place of 0.02 s. Threads get one
    heap together, so that one takes what another has freed. Commands that stream long recordings
    leave it: their peak would double.

    Only glibc, the C library of most Linux systems, has these settings. Elsewhere nothing
    happens.

    Args:
        platform: As `sys.platform`.
    """
    if not platform.startswith("linux"):
        return False
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    if mallopt is None:  # musl, as in Alpine Linux.
        return False
    settings = (_M_TRIM_THRESHOLD, _KEPT_BYTES), (_M_MMAP_MAX, 0), (_M_ARENA_MAX, 1)
    return sum(mallopt(number, value) for number, value in settings) == len(settings)


@contextmanager
def memory_beforehand(size: int) -> Iterator[None]:
    """Let a thread of its own have the kernel hand out memory while the block runs.

    The kernel hands out memory page by page as it is first used, and clears every page: a sixth of
    the time of a diagnosis' sums. While the program is imported a core is free for that, and pages
    of two megabytes in place of four kilobytes, where the kernel has them, take a third of the
    time. After the block the memory is free for the tensors that come, however much of it there is:
    a kernel that must first clear up for large pages took two seconds longer than the imports. Only
    after `keep_freed_memory`.

    Args:
        size: Bytes.
    """
    library = ctypes.CDLL(None)
    library.malloc.restype, library.malloc.argtypes = ctypes.c_void_p, (ctypes.c_size_t,)
    library.free.argtypes = (ctypes.c_void_p,)
    library.madvise.argtypes = ctypes.c_void_p, ctypes.c_size_t, ctypes.c_int
    start = library.malloc(size)
    if start is None:
        yield
        return

    enough = Event()

    def hand_out() -> None:
        first = start + _AT_ONCE - start % _AT_ONCE
        library.madvise(first, max(start + size - first, 0), _MADV_HUGEPAGE)  # Or small ones.
        for place in range(first, start + size - _AT_ONCE, _AT_ONCE):
            if enough.is_set() or library.madvise(place, _AT_ONCE, _MADV_POPULATE_WRITE):
                return  # The latter: an older kernel, or there is no more.

    thread = Thread(target=hand_out)
    thread.start()
    try:
        yield
    finally:
        enough.set()
        thread.join()
        library.free(start)
