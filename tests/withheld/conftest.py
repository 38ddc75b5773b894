import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parents[2]))


@pytest.fixture(autouse=True)
def one_thread_for_small_matrices() -> Iterator[None]:
    """Threads of linear algebra that wait for one another cost more than they bring here."""
    threadpoolctl = pytest.importorskip("threadpoolctl", reason="comes with scikit-learn (bench)")
    with threadpoolctl.threadpool_limits(1):
        yield
