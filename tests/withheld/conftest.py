import sys
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

if TYPE_CHECKING:
    from benchmarks.withheld.generator.pairs import Pair

sys.path.insert(0, str(Path(__file__).parents[2]))


@pytest.fixture(autouse=True)
def one_thread_for_small_matrices() -> Iterator[None]:
    """Threads of linear algebra that wait for one another cost more than they bring here."""
    threadpoolctl = pytest.importorskip("threadpoolctl", reason="comes with scikit-learn (bench)")
    with threadpoolctl.threadpool_limits(1):
        yield


@pytest.fixture(scope="session")
def ideal() -> "Pair":
    """A small pair with a row and column pattern of 5 mm, and a session of its camera held out."""
    from withheld.small_pairs import a_pair  # The path to `benchmarks` is set above.

    return a_pair(withheld=(("row_column_pattern", 5.0),), held_out=True)
