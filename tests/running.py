"""The command line, run in the process of the tests."""

from collections.abc import Callable
from typing import NamedTuple


class Said(NamedTuple):
    """Exit code of a command, and what it printed on standard output and standard error."""

    code: int
    out: str
    err: str


Program = Callable[..., Said]
"""`tofcorr ARGUMENTS`; the fixture `program` is one."""
