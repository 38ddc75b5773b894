"""How the program's memory is managed: set once, before a command runs."""

import ctypes
import gc
import sys

# Numbers of three parameters of `mallopt`. Derived: those of malloc.h in glibc.
_M_TRIM_THRESHOLD, _M_MMAP_MAX, _M_ARENA_MAX = -1, -4, -8
# Freed memory at the end of the heap that is kept for the next tensor, bytes. Chosen: more than a
# diagnosis frees at once, so that its memory is cleared once.
_KEPT_BYTES = 1024**3
# Net number of new containers that starts a search for unreachable ones. Python's own 700 starts
# 703 searches while `tofcorr diagnose` is imported, a seventh of the time that takes. Measured.
_NEW_CONTAINERS = 10_000
# So many are there before the first search, and none of them is ever searched. Chosen: what a
# command imports has 340,000, and searches of every 10,000 took 0.1 s while it was imported.
_OF_IMPORTS = 300_000


def set_up_memory() -> None:
    """Search for unreachable objects less often.

    It is for a program that runs one command and ends. `import tofcorr` sets nothing.
    """
    gc.set_threshold(_OF_IMPORTS)
    gc.callbacks.append(_leave_out_imports)


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
