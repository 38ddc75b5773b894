"""The caller's number of threads stands again, whatever happens in between."""

import pytest
import torch

from tofcorr.pixels.thread_number import thread_number, threads_at_once


@pytest.mark.parametrize(("asked", "used"), [(1, 1), (2, 2), (None, 3)])
def test_the_number_holds_inside_and_the_callers_own_after(asked: int | None, used: int) -> None:
    before = torch.get_num_threads()
    try:
        torch.set_num_threads(3)
        with thread_number(asked):
            assert torch.get_num_threads() == used
            assert threads_at_once() == 3
        assert torch.get_num_threads() == 3
        with pytest.raises(ZeroDivisionError), thread_number(asked):
            _ = 1 / 0
        assert torch.get_num_threads() == 3
    finally:
        torch.set_num_threads(before)
