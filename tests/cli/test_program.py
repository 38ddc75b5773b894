"""The program ends at once, but not before what it began is done."""

import subprocess
import sys
from pathlib import Path

import pytest

_PROGRAM = """
import atexit, sys, threading, time
import tofcorr.cli.program as program

def main():
    threading.Thread(target=lambda: (time.sleep(0.2), print("thread"))).start()
    atexit.register(print, "handler")
    print("x" * 200_000)
    {end}

program.main = main
program.run()
"""


def _ended(end: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-c", _PROGRAM.format(end=end)]
    return subprocess.run(command, capture_output=True, text=True, check=False)


@pytest.mark.parametrize(
    ("end", "status", "told"),
    [
        ("return", 0, ""),
        ("sys.exit(3)", 3, ""),
        ("sys.exit()", 0, ""),
        ("sys.exit('why')", 1, "why\n"),
        ("raise RuntimeError('what')", 1, "RuntimeError: what\n"),
    ],
)
def test_all_is_printed_and_threads_and_handlers_have_ended(
    end: str, status: int, told: str
) -> None:
    done = _ended(end)
    assert done.returncode == status
    assert done.stdout == "x" * 200_000 + "\nthread\nhandler\n"
    assert done.stderr.endswith(told)
    assert bool(told) or not done.stderr


def test_objects_are_not_freed_one_by_one() -> None:
    """Python's own end would free this one, and print so."""
    end = "global kept; kept = type('Kept', (), {'__del__': lambda self: print('freed')})()"
    assert "freed" not in _ended(end).stdout


@pytest.mark.parametrize("words", [["-m", "tofcorr"], [str(Path("scripts") / "train.py")]])
def test_unusable_arguments_end_with_two(words: list[str]) -> None:
    root = Path(__file__).parents[2]
    command = [sys.executable, *words, "--nonsense"]
    done = subprocess.run(command, capture_output=True, text=True, check=False, cwd=root)
    assert done.returncode == 2
    assert "No such option" in done.stderr
