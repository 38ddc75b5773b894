"""One command in a forked process: run, killed at a moment, or on a disk that is full."""

import errno
import os
import resource
import signal
import sys
import time
import traceback
from dataclasses import dataclass
from pathlib import Path

from tofcorr.cli import main as program

_HELD = (signal.SIGTERM, signal.SIGINT)

# What a command does to files, as Python announces it. The data of C++ writers are not among them.
_EVENTS = {"open", "os.rename", "os.mkdir", "os.rmdir", "os.remove", "shutil.rmtree"}
_PATIENCE = 900.0
"""Seconds until a command counts as one that does not end, on a machine that does much else."""


@dataclass(frozen=True, kw_only=True)
class Moment:
    """When something happens to a run, and what.

    Attributes:
        what: A signal; None: from then on, files cannot be opened for want of space.
        after: Seconds since the start; None: at an operation on a file.
        operation: Number of that operation.
        file_limit: Largest size of a file, bytes; None: no limit.
    """

    what: signal.Signals | None = None
    after: float | None = None
    operation: int | None = None
    file_limit: int | None = None


@dataclass(frozen=True, kw_only=True)
class Ended:
    """How a run ended.

    Attributes:
        code: Exit code, or minus the number of the signal that ended it.
        told: What it printed.
        operations: Operations on files.
        seconds: How long it took.
        hung: Whether it had to be killed for not ending.
    """

    code: int
    told: str
    operations: int
    seconds: float
    hung: bool = False


def run(words: tuple[str, ...], folder: Path, log: Path, moment: Moment | None = None) -> Ended:
    """Run a command in a folder, in a process forked from this one.

    Args:
        words: Its arguments.
        folder: Where it runs.
        log: Where its output goes; beside it, the number of operations.
        moment: What happens to it; None: nothing.
    """
    moment = moment or Moment()
    count, start = log.with_suffix(".count"), time.monotonic()
    count.write_bytes(b"0")
    # Held back until the program itself has begun: what comes earlier would hit this module.
    signal.pthread_sigmask(signal.SIG_BLOCK, _HELD)
    child = os.fork()
    if not child:
        _become(words, folder, log, count, moment)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, _HELD)
    hung = False
    if moment.after is not None and moment.what is not None:
        left = start + moment.after - time.monotonic()
        if not _ends_within(child, max(0.0, left)):
            os.kill(child, moment.what)
    if not _ends_within(child, _PATIENCE):
        os.kill(child, signal.SIGKILL)
        hung = True
    _, status = os.waitpid(child, 0)
    return Ended(
        code=os.waitstatus_to_exitcode(status),
        told=log.read_text(encoding="utf-8", errors="replace"),
        operations=int(count.read_bytes() or b"0"),
        seconds=time.monotonic() - start,
        hung=hung,
    )


def _ends_within(child: int, seconds: float) -> bool:
    """Wait for a child without reaping it."""
    end = time.monotonic() + seconds
    while True:
        if os.waitid(os.P_PID, child, os.WEXITED | os.WNOWAIT | os.WNOHANG):
            return True
        if time.monotonic() >= end:
            return False
        time.sleep(min(0.002, seconds))


def _become(words: tuple[str, ...], folder: Path, log: Path, count: Path, moment: Moment) -> None:
    """Run the command in this process, and never return."""
    code = 1
    try:
        signal.signal(signal.SIGINT, signal.default_int_handler)
        os.chdir(folder)
        written = os.open(log, os.O_CREAT | os.O_TRUNC | os.O_WRONLY)
        os.dup2(written, 1)
        os.dup2(written, 2)
        counted = os.open(count, os.O_WRONLY)
        if moment.file_limit is not None:
            # As a full disk does: the write that goes beyond fails, with EFBIG for ENOSPC.
            resource.setrlimit(resource.RLIMIT_FSIZE, (moment.file_limit, moment.file_limit))
        _watch(str(folder), counted, moment)
        sys.argv = ["tofcorr", *words]
        begin = program.set_up_threads

        def begun() -> None:
            signal.pthread_sigmask(signal.SIG_UNBLOCK, _HELD)
            begin()

        program.set_up_threads = begun
        try:
            program.main()
            code = 0
        except SystemExit as done:
            code = int(done.code or 0)
        except BaseException:  # noqa: BLE001 - as the interpreter does
            traceback.print_exc()
        sys.stdout.flush()
        sys.stderr.flush()
    finally:
        os._exit(code)


def _watch(folder: str, counted: int, moment: Moment) -> None:
    """Count the operations on files of a folder, and let the moment come at one of them."""
    number = 0

    def hook(event: str, arguments: tuple[object, ...]) -> None:
        nonlocal number
        if event not in _EVENTS or not arguments:
            return
        name = arguments[0]
        if not isinstance(name, str | bytes | os.PathLike):
            return
        path = str(Path(os.fsdecode(name)).absolute())
        changes = event != "open" or (isinstance(arguments[2], int) and arguments[2] & _WRITES)
        if not path.startswith(folder) or not changes:
            return
        number += 1
        os.pwrite(counted, str(number).encode(), 0)
        if moment.operation is None or number < moment.operation:
            return
        if moment.what is None:
            if event in ("open", "os.mkdir"):
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), os.fsdecode(name))
        elif number == moment.operation:
            os.kill(os.getpid(), moment.what)

    sys.addaudithook(hook)


_WRITES = os.O_WRONLY | os.O_RDWR | os.O_CREAT
