"""The caller's number of threads stands again, whatever happens in between."""

import subprocess
import sys

import pytest
import torch

from tofcorr.pixels.thread_number import one_thread, thread_number, threads_at_once


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


def test_where_one_thread_computes_already_the_callers_number_stays() -> None:
    before = torch.get_num_threads()
    try:
        torch.set_num_threads(3)
        with thread_number(1), one_thread():
            assert (torch.get_num_threads(), threads_at_once()) == (1, 3)
        with one_thread():
            assert (torch.get_num_threads(), threads_at_once()) == (1, 3)
        assert torch.get_num_threads() == 3
    finally:
        torch.set_num_threads(before)


def test_a_library_that_is_loaded_later_is_limited_too() -> None:
    program = """
from threadpoolctl import threadpool_info, threadpool_limits
from tofcorr.pixels.thread_number import numpy_threads

def used():
    return {one["num_threads"] for one in threadpool_info() if one["user_api"] == "blas"}

with numpy_threads(1):
    assert used() == {1}
import scipy.linalg
threadpool_limits(2, user_api="blas")
with numpy_threads(1):
    print(used())
"""
    command = [sys.executable, "-c", program]
    printed = subprocess.run(command, capture_output=True, text=True, check=False)
    assert printed.stdout.strip() == "{1}", printed.stderr
