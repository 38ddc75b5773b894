"""Two pieces of work at once, each by a process of its own.

Two threads of Python wait for one another; two processes do not. A copy of this process does what
this one does, step by step, so that both have all there is in memory. Where pieces of work are
independent, each process does some and sends the results to the other. If the copy ends, for
whatever reason, this process goes on alone: nothing is lost with it.
"""

import io
import os
import pickle
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, nullcontext
from contextvars import ContextVar
from multiprocessing import Pipe
from multiprocessing.connection import Connection
from typing import Any, TypeVar

from tofcorr.pixels.copied_process import copy_process, end_copy
from tofcorr.pixels.thread_number import thread_number
from tofcorr.progress import LOG

Result = TypeVar("Result")

# Bytes of a ticket, and how many there are: each piece of work that `all_at_once` shares out takes
# one, and each process one more. A diagnosis takes 70 to 200; every pipe holds 4,096 bytes.
_TICKET_BYTES, _TICKETS = 4, 1_000

# The other process, and whether this one is the copy.
_partner: ContextVar["_Partner | None"] = ContextVar("process beside this one", default=None)


class _Partner:
    """The process beside this one.

    Args:
        line: To it.
        copy: Its number if it is the copy, 0 if this process is.
        tickets: A pipe of numbers that count up; both processes read from it, each number once.
            (Of a file both may read the same: its place moves after the reading.)
        shared: What both have, and send by its number.
    """

    def __init__(self, line: Connection, copy: int, tickets: int, shared: Sequence[object]) -> None:
        self._line, self._copy, self._tickets, self._shared = line, copy, tickets, shared
        self._count = self._first = 0

    @property
    def is_copy(self) -> bool:
        """Whether it is the copy, and this process the program."""
        return bool(self._copy)

    def taken(self, count: int) -> Iterator[int]:
        """Yield numbers below a count, each to one of both processes, as soon as it asks for it."""
        first = self._first
        self._first += count + 2  # Each process finds once that none is left.
        while ticket := os.read(self._tickets, _TICKET_BYTES):
            number = int.from_bytes(ticket, sys.byteorder) - first
            if number >= count:
                return
            yield number

    def exchange(self, found: object, about: Sequence[str]) -> Any:  # noqa: ANN401 - of any kind
        """Send what this process has found, and return what the other has.

        Args:
            found: What is sent.
            about: What it is about.

        Raises:
            EOFError: The other one has ended, or has come another way.
            OSError: It ended meanwhile.
        """
        self._count += 1
        step = self._count, *about
        message = _dumped((step, found), self._shared)
        # One listens while the other speaks: both speaking would fill the line and wait forever.
        if self._copy:
            self._line.send_bytes(message)
            answer = self._line.recv_bytes()
        else:
            answer = self._line.recv_bytes()
            self._line.send_bytes(message)
        its_step, other = _Unpickler(answer, self._shared).load()
        if its_step != step:
            raise EOFError
        return other

    def end(self) -> None:
        """End the copy, if it still runs; the copy ends itself."""
        if not self._copy:
            os._exit(0)
        self._line.close()
        os.close(self._tickets)
        end_copy(self._copy)


class _Pickler(pickle.Pickler):
    """Replaces what both processes share by its number."""

    def __init__(self, file: io.BytesIO, shared: Sequence[object]) -> None:
        super().__init__(file, protocol=pickle.HIGHEST_PROTOCOL)
        self._numbers = {id(one): number for number, one in enumerate(shared)}

    def persistent_id(self, obj: object) -> int | None:
        """Return the number of a shared object, None of any other."""
        return self._numbers.get(id(obj))


class _Unpickler(pickle.Unpickler):
    """Reads what a `_Pickler` of the other process has written."""

    def __init__(self, message: bytes, shared: Sequence[object]) -> None:
        super().__init__(io.BytesIO(message))
        self._shared = shared

    def persistent_load(self, pid: int) -> object:
        """Return the shared object of a number."""
        return self._shared[pid]


def _dumped(found: object, shared: Sequence[object]) -> memoryview:
    file = io.BytesIO()
    _Pickler(file, shared).dump(found)
    return file.getbuffer()


@contextmanager
def two_processes(allowed: bool, shared: Sequence[object] = ()) -> Iterator[None]:
    """Run the block in this process and in a copy of it, which ends with the block.

    Args:
        allowed: False: there is no copy. Otherwise it is made where `copy_process` makes one.
        shared: Objects that results refer to and nothing changes. Each process keeps its own; they
            are not sent, which would copy all images of a recording.
    """
    partner = _copied(shared) if allowed else None
    before = _partner.set(partner)
    try:
        with thread_number(None if partner is None else 1):
            yield
    finally:
        _partner.reset(before)
        if partner is not None:
            partner.end()


def all_at_once(pieces: Sequence[Callable[[], Any]], about: Sequence[str] = ()) -> list[Any]:
    """Return the results of some pieces of work; inside `two_processes` two are done at a time.

    Each process takes the next piece when it has done the last. So long ones come first.

    Args:
        pieces: None changes anything that is used afterwards or by another one, or writes a file.
            Their results can be pickled.
        about: What they are about: only processes that agree on it take results of one another.
    """
    partner = _partner.get()
    found: dict[int, Any] = {}
    if partner is not None:
        with nullcontext() if partner.is_copy else _heard():
            for number in partner.taken(len(pieces)):
                found[number] = _by_itself(pieces[number])
        try:
            found |= partner.exchange(found, about)
        except (EOFError, OSError):
            if not partner.is_copy:
                raise
            _partner.set(None)
    return [found[number] if number in found else piece() for number, piece in enumerate(pieces)]


def _by_itself(work: Callable[[], Result]) -> Result:
    """Do work of which the other process knows nothing: all that it would share, this one does."""
    before = _partner.set(None)
    try:
        return work()
    finally:
        _partner.reset(before)


def _copied(shared: Sequence[object]) -> _Partner | None:
    """Copy this process; return the other one in each, or None if no copy could be made."""
    here, there = Pipe()
    tickets, box = os.pipe()
    os.write(box, b"".join(n.to_bytes(_TICKET_BYTES, sys.byteorder) for n in range(_TICKETS)))
    os.close(box)
    copy = copy_process((here, there))
    if copy is None:
        os.close(tickets)
        return None
    return _Partner(here if copy else there, copy, tickets, shared)


@contextmanager
def _heard() -> Iterator[None]:
    """Let the copy log the steps that it alone takes."""
    LOG.disabled = False
    try:
        yield
    finally:
        LOG.disabled = True
