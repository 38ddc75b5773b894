"""How the program's memory is managed: set once, before a command runs."""

import atexit
import ctypes
import gc
import sys

# Numbers of two parameters of `mallopt`. Derived: those of malloc.h in glibc.
_M_TRIM_THRESHOLD, _M_MMAP_MAX = -1, -4
# Freed memory at the end of the heap that is kept for the next tensor, bytes. Chosen: more than a
# diagnosis frees at once, so that its memory is cleared once.
_KEPT_BYTES = 512 * 1024**2
# Net number of new containers that starts a search for unreachable ones. Python's own 700 starts
# 703 searches while `tofcorr diagnose` is imported, a seventh of the time that takes; this number
# 48. Measured; more gains nothing.
_NEW_CONTAINERS = 10_000


def set_up_memory() -> None:
    """Search for unreachable objects less often, and not when the program ends.

    The last search, through all that torch has made, took half a second.

    It is for a program that runs one command and ends. `import tofcorr` sets nothing.
    """
    gc.set_threshold(_NEW_CONTAINERS)
    atexit.register(gc.freeze)


def keep_freed_memory(platform: str = sys.platform) -> bool:
    """Tell the C library to keep what is freed; return whether it could be told.

    The C library of Linux otherwise gives every large tensor back to the kernel when it is freed.
    The kernel then clears the same memory for the next one, page by page, which takes longer than
    the arithmetic: a tensor of 80 MB and its double took 0.08 s in place of 0.02 s. Commands that
    stream long recordings leave it: their peak would double.

    Only glibc, the C library of most Linux systems, has the two settings. Elsewhere nothing
    happens.

    Args:
        platform: As `sys.platform`.
    """
    if not platform.startswith("linux"):
        return False
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    if mallopt is None:  # musl, as in Alpine Linux.
        return False
    kept = mallopt(_M_TRIM_THRESHOLD, _KEPT_BYTES)
    return bool(mallopt(_M_MMAP_MAX, 0)) and bool(kept)
