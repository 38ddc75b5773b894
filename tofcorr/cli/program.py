"""The command line as a process of its own: it ends at once when it is done."""

import atexit
import os
import sys

from tofcorr.cli.main import main


def run() -> None:
    """Run `main`, and end the process without giving its memory back piece by piece.

    Python frees every object before it ends, and torch what it registered: 0.1 to 0.3 s. The system
    takes all of it back at once. By then other threads have ended, exit handlers have run, and what
    was printed is out.
    """
    status = 1  # Of an error that nothing caught.

    def leave() -> None:
        try:
            sys.stdout.flush()
            sys.stderr.flush()
        except OSError:  # Nobody reads it any more; Python's own end says so.
            return
        os._exit(status)

    atexit.register(leave)  # What is registered first is called last.
    try:
        main()
        status = 0
    except SystemExit as end:
        status = end.code if isinstance(end.code, int) else int(end.code is not None)
        raise
