"""A copy of this process: it has all that this one has in memory, and ends with it."""

import ctypes
import os
import signal
import sys
import warnings
from contextlib import suppress
from multiprocessing.connection import Connection
from pathlib import Path
from threading import Thread

import torch

from tofcorr.pixels.thread_number import threads_at_once
from tofcorr.progress import LOG, hide_bars

# Signals that end the program; a copy must not handle them as the program does.
_ENDING = (signal.SIGINT, signal.SIGTERM)
# Number of the option of `prctl` that names the signal a process gets when its parent ends: that of
# linux/prctl.h.
_PR_SET_PDEATHSIG = 1


def copy_process(ends: tuple[Connection, Connection]) -> int | None:
    """Copy this process, on Linux, where torch could use a second core.

    One thread must share an operation of torch: a copy has none of the other threads.

    Args:
        ends: Of the line between both, that of the program first; each process closes the other's.

    Returns:
        The number of the copy, in the program; 0 in the copy; None if no copy was made.
    """
    if not _worth_it():
        return None
    program = os.getpid()
    # Until it ignores them, no signal may reach the copy: it would tidy up for the program.
    before = signal.pthread_sigmask(signal.SIG_BLOCK, _ENDING)
    try:
        copy = os.fork()
        if not copy:
            _become_the_copy(program, ends[0])
            return 0
    except OSError:  # No process or no memory is left for a copy.
        return None
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
    ends[1].close()
    return copy


def end_copy(copy: int) -> None:
    """End a copy, if it still runs, without waiting until the system has taken its memory back."""
    with suppress(ProcessLookupError):
        os.kill(copy, signal.SIGKILL)
    Thread(target=os.waitpid, args=(copy, 0), daemon=True).start()


def _worth_it() -> bool:
    linux = sys.platform.startswith("linux")
    return linux and torch.get_num_threads() == 1 and threads_at_once() > 1


def _become_the_copy(program: int, its_end: Connection) -> None:
    """Leave signals, words and pictures to the program, and end when it ends."""
    ready = False
    try:
        signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches both; the program ends both.
        signal.signal(signal.SIGTERM, signal.SIG_DFL)
        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
        its_end.close()
        # Where memory runs out, the copy goes first: the program can do without it.
        with suppress(OSError):
            Path("/proc/self/oom_score_adj").write_text("1000", encoding="ascii")
        hide_bars()
        warnings.simplefilter("ignore")
        LOG.disabled = True
        ready = os.getppid() == program
    finally:
        if not ready:
            os._exit(1)
