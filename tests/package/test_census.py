"""The count of what a maintainer must hold in mind counts what it says."""

from pathlib import Path

from scripts.census import census, excess

SOURCE = '''\
"""A docstring
of two lines."""

import math
from dataclasses import dataclass

# A comment.
_FAR, _NEAR = 2.5, 1
NAME = "no number"


@dataclass
class Point:
    """Another docstring."""

    x: float = 0.3


def circle(radius: float) -> float:
    return 1 / 4 * math.pi * (2 * radius) ** 2 + 0.5
'''


def test_counts_are_those_of_a_hand(tmp_path: Path) -> None:
    folder = tmp_path / "some"
    folder.mkdir()
    (folder / "one.py").write_text(SOURCE)
    (folder / "two.py").write_text("from some.one import circle\n\nprint(circle(1.0))\n")
    expected = {"files": 2, "statements": 2 + 3 + 2 + 1, "numbers": 2 + 1}
    assert census(folder) == expected | {"records": 1, "single": 1}


def test_only_what_grew_is_refused() -> None:
    budget = {"some": {"files": 2, "records": 1}}
    assert excess({"some": {"files": 2, "records": 0}}, budget) == []
    (said,) = excess({"some": {"files": 3, "records": 1}}, budget)
    assert said.startswith("some has 3 files, 2 were there before")
