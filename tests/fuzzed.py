"""Files damaged at random are read, or refused in words."""

from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from benchmarks import fuzz

MANY = pytest.param(1000, marks=pytest.mark.slow)
"""So many examples are drawn of a file by the long checks."""


def is_refused(target: fuzz.Target, folder: Path, content: bytes) -> bool:
    """Say whether content is refused in words; the only other way is that it is read."""
    said, where = fuzz.outcome(target, folder, content)
    assert said in ("refused", "accepted"), where
    return said == "refused"


def read_or_refused(target: fuzz.Target, folder: Path, examples: int) -> None:
    """Read a target as it is, and damaged; only an error meant for people may come."""
    assert not is_refused(target, folder, target.content)

    @settings(max_examples=examples, suppress_health_check=list[Any](HealthCheck))
    @given(st.data())
    def law(data: st.DataObject) -> None:
        is_refused(target, folder, data.draw(fuzz.mutated(target)))

    law()
