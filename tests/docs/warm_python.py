"""Python that has loaded tofcorr already: each program is a fork of one process that waits.

    python warm_python.py SOCKET            # waits, and forks for every caller
    python -SE warm_python.py SOCKET PROGRAM ARGUMENTS ...

Starting Python and torch takes two seconds; the commands of the documents are many.
"""

import gc
import json
import os
import runpy
import signal
import socket
import sys
import traceback
from pathlib import Path

STANDARD = (0, 1, 2)


def call(place: str, words: list[str]) -> int:
    """Run a program in a fork, with the streams, folder and environment of this process."""
    asked = {"words": words, "folder": str(Path.cwd()), "environment": dict(os.environ)}
    text = json.dumps(asked).encode()
    with socket.socket(socket.AF_UNIX) as to:
        to.connect(place)
        socket.send_fds(to, [len(text).to_bytes(8)], STANDARD)
        to.sendall(text)
        return int(to.recv(16) or b"1")


def wait_for_calls(place: str) -> None:
    """Load the package, then serve until this process is ended."""
    import tofcorr

    for name in tofcorr.__all__:
        getattr(tofcorr, name)
    import tofcorr.cli.main
    import tofcorr.importing.posed

    gc.freeze()  # The forks share what is loaded.
    # Nobody waits for the forks of this process.
    signal.signal(signal.SIGCHLD, signal.SIG_IGN)
    with socket.socket(socket.AF_UNIX) as of:
        of.bind(place)
        of.listen()
        print("ready", flush=True)  # noqa: T201 - whoever started this waits for it
        while True:
            caller, _ = of.accept()
            if not os.fork():
                signal.signal(signal.SIGCHLD, signal.SIG_DFL)
                return _serve(caller)
            caller.close()


def _serve(caller: socket.socket) -> None:
    """Run the program in one more fork, and tell the caller how it ended."""
    size, streams, *_ = socket.recv_fds(caller, 8, len(STANDARD))
    asked = json.loads(caller.makefile("rb").read(int.from_bytes(size)))
    if child := os.fork():
        _, status = os.waitpid(child, 0)
        caller.sendall(str(os.waitstatus_to_exitcode(status)).encode())
        os._exit(0)
    for stream, number in zip(streams, STANDARD, strict=True):
        os.dup2(stream, number)
    os.chdir(asked["folder"])
    os.environ.clear()
    os.environ.update(asked["environment"])
    sys.argv = asked["words"]
    code: object = 0
    try:
        runpy.run_path(sys.argv[0], run_name="__main__")
    except SystemExit as done:
        code = done.code or 0
    except BaseException:  # noqa: BLE001 - as Python ends on it
        traceback.print_exc()
        code = 1
    sys.stdout.flush()
    sys.stderr.flush()
    # Nothing is tidied up: taking torch apart takes a second, and every page of its memory.
    os._exit(code if isinstance(code, int) else 1)


if __name__ == "__main__":
    if sys.argv[2:]:
        sys.exit(call(sys.argv[1], sys.argv[2:]))
    wait_for_calls(sys.argv[1])
