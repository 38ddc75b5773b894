"""Freed memory is kept for the next tensor where the C library allows, by the program alone."""

import ctypes
import subprocess
import sys

import pytest

from tofcorr.cli import memory

# Page faults of a second block of 50 MB, of the same size as the first, which was freed: 12 000
# pages if the kernel has to hand them out again.
_SECOND_BLOCK = """
import resource, sys
from tofcorr.cli.memory import keep_freed_memory
if not keep_freed_memory():
    print("no glibc", 0)
    sys.exit()
bytearray(50_000_000)
before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
bytearray(50_000_000)
print("glibc", resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before)
"""


def test_a_block_takes_the_memory_of_the_one_freed_before() -> None:
    done = subprocess.run(
        [sys.executable, "-c", _SECOND_BLOCK], check=True, capture_output=True, text=True
    )
    assert int(done.stdout.split()[-1]) < 1000


# What is there when the first search starts is left out, and later searches find the rest.
_IMPORTED = """
import gc
from tofcorr.cli.memory import set_up_memory
set_up_memory()
imported = [[] for _ in range(310_000)]
first = gc.get_freeze_count()
class Found:
    def __del__(self):
        print("found")
found = Found()
found.itself = found
del found
more = [[] for _ in range(20_000)]
print(300_000 < first == gc.get_freeze_count())
"""


def test_what_is_imported_is_searched_for_unreachable_objects_never_and_the_rest_is() -> None:
    words = [sys.executable, "-c", _IMPORTED]
    done = subprocess.run(words, check=True, capture_output=True, text=True)
    assert done.stdout == "found\nTrue\n"


@pytest.mark.parametrize("platform", ["darwin", "win32"])
def test_another_system_is_left_alone(platform: str, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(_name: str | None) -> None:
        raise AssertionError("the C library of another system was opened")

    monkeypatch.setattr(ctypes, "CDLL", refuse)
    assert not memory.keep_freed_memory(platform)


def test_a_c_library_without_the_settings_is_left_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ctypes, "CDLL", lambda _name: object())
    assert not memory.keep_freed_memory("linux")


def test_importing_the_package_changes_nothing_and_the_program_does() -> None:
    code = (
        "import gc; own = gc.get_threshold(); import tofcorr.cli.main as m; "
        "assert gc.get_threshold() == own; "
        "m.group = lambda **_: print(gc.get_threshold()[0] > own[0]); m.main()"
    )
    done = subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True)
    assert done.stdout.split() == ["True"]
