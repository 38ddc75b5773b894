"""What tests of several threads and processes share."""

from collections.abc import Iterator

import pytest
import torch

from tofcorr.pixels.thread_number import thread_number


@pytest.fixture
def two_cores() -> Iterator[None]:
    """Torch may use two cores, and one thread shares an operation."""
    before = torch.get_num_threads()
    torch.set_num_threads(2)
    try:
        with thread_number(1):
            yield
    finally:
        torch.set_num_threads(before)
