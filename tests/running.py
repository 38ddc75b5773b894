"""The command line, run in the process of the tests; and programs in processes of their own."""

import os
import subprocess
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple


class Said(NamedTuple):
    """Exit code of a command, and what it printed on standard output and standard error."""

    code: int
    out: str
    err: str


def printed(*words: object, **how: Any) -> str:
    """Run a program in a process of its own, which must end well; return its standard output."""
    done = subprocess.run([*map(str, words)], capture_output=True, text=True, check=False, **how)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def printed_alone(python: Path | str, folder: Path, *arguments: str) -> str:
    """Return what `python ARGUMENTS` prints, run in `folder` as a user without the repository.

    With the repository in PYTHONPATH, its `tofcorr.egg-info` passed for an installed tofcorr, and
    pip installed nothing.
    """
    clean = {key: value for key, value in os.environ.items() if not key.startswith("PYTHON")}
    return printed(python, *arguments, cwd=folder, env=clean)


Program = Callable[..., Said]
"""`tofcorr ARGUMENTS`; the fixture `program` is one."""
