"""Runs attempts in forked processes with limits on time and memory, and collects what came."""

import json
import mmap
import os
import random
import resource
import signal
import struct
import sys
import tempfile
import traceback
import warnings
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from benchmarks.fuzzing.target import SilentlyDifferentError, Target
from tofcorr.errors import TofcorrError

_SECONDS = 20.0
_MEMORY = 4 * 2**30
_LONGEST_MESSAGE = 5000


class _TooSlowError(BaseException):
    """An attempt took more than the seconds that it may."""


@dataclass
class Tally:
    """What came of the attempts.

    Attributes:
        outcomes: How many were refused, accepted, or failed, by target and outcome.
        failures: Target, number, kind and place of each failure.
    """

    outcomes: Counter[str] = field(default_factory=Counter)
    failures: list[dict[str, Any]] = field(default_factory=list)


def run_all(target: Target, seed: int, numbers: Sequence[int], tally: Tally) -> None:
    """Run the attempts of some numbers; a process that dies is a failure, and the next goes on."""
    place = mmap.mmap(-1, 8)
    todo = list(numbers)
    while todo:
        with tempfile.TemporaryDirectory() as folder:
            log = Path(folder) / "log"
            log.touch()
            child = os.fork()
            if not child:
                _child(target, seed, todo, Path(folder), place)
            _, status = os.waitpid(child, 0)
            for line in log.read_text(encoding="utf-8").splitlines():
                _count(json.loads(line), target, tally)
        if not status:
            return
        (number,) = struct.unpack("q", place[:8])
        how = f"signal {os.WTERMSIG(status)}" if os.WIFSIGNALED(status) else f"exit {status >> 8}"
        _count({"number": number, "outcome": "died", "what": how}, target, tally)
        todo = todo[todo.index(number) + 1 :]


def _count(line: dict[str, Any], target: Target, tally: Tally) -> None:
    tally.outcomes[line["outcome"]] += 1
    if line["outcome"] not in ("refused", "accepted"):
        tally.failures.append({"target": target.name, **line})


def _child(target: Target, seed: int, numbers: list[int], folder: Path, place: mmap.mmap) -> None:
    code = 3
    try:
        _limit()
        with (folder / "log").open("w", encoding="utf-8") as log:
            for number in numbers:
                place[:8] = struct.pack("q", number)
                found = one(target, seed, number, folder)
                log.write(json.dumps({"number": number} | found) + "\n")
                log.flush()
        code = 0
    finally:
        os._exit(code)


def one(target: Target, seed: int, number: int, folder: Path) -> dict[str, str]:
    """Run one attempt and say what came of it."""
    generator = random.Random(f"{seed} {target.name} {number}")
    signal.setitimer(signal.ITIMER_PROF, _SECONDS)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            target.attempt(generator, folder)
    except TofcorrError as error:
        text = str(error)
        if "\n" in text or len(text) > _LONGEST_MESSAGE:
            return {"outcome": "not one sentence", "what": text[:300]}
        return {"outcome": "refused"}
    except SilentlyDifferentError as error:
        return {"outcome": "silently different", "what": str(error)[:300]}
    except _TooSlowError:
        return {"outcome": "slow", "what": _where(sys.exc_info()[2])}
    except BaseException as error:  # noqa: BLE001 - any traceback is what is looked for
        kind = "memory" if isinstance(error, MemoryError) else "traceback"
        shown = f"{type(error).__name__}: {error}"[:200]
        return {"outcome": kind, "what": f"{_where(error.__traceback__)} {shown}"}
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0)
    return {"outcome": "accepted"}


def _where(trace: object) -> str:
    """Return the last line of the package in a traceback."""
    frames = [f for f in traceback.extract_tb(trace) if "/tofcorr/" in f.filename]  # type: ignore[arg-type]
    if not frames:
        return "outside"
    last = frames[-1]
    return f"{last.filename.rpartition('/tofcorr/')[2]}:{last.lineno}"


def _limit() -> None:
    """Bound memory and time, and silence what libraries print."""
    pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[0])
    most = pages * resource.getpagesize() + _MEMORY
    resource.setrlimit(resource.RLIMIT_AS, (most, most))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))

    def stop(*_: object) -> None:
        raise _TooSlowError

    signal.signal(signal.SIGPROF, stop)
    null = os.open(os.devnull, os.O_WRONLY)
    os.dup2(null, 1)
    os.dup2(null, 2)
