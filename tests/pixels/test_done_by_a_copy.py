"""What a copy does is as if this process had done it, whatever becomes of the copy."""

import os
import signal
import sys
import time

import pytest
import torch

from tofcorr.pixels.done_by_a_copy import done_by_a_copy

pytestmark = [
    pytest.mark.skipif(not sys.platform.startswith("linux"), reason="Linux copies safely"),
    pytest.mark.usefixtures("two_cores"),
]


def test_a_copy_does_the_work_beside_the_block_and_is_gone_after_it() -> None:
    with done_by_a_copy(lambda: (os.getpid(), torch.ones(10**6)), True) as result:
        process, ones = result()
    assert process != os.getpid()
    assert float(ones.sum()) == 10**6
    for _ in range(200):
        try:
            os.kill(process, 0)
        except ProcessLookupError:
            return
        time.sleep(0.01)
    pytest.fail("the copy is still there")


def test_where_no_copy_is_allowed_the_work_comes_before_the_block() -> None:
    steps: list[str] = []
    with done_by_a_copy(lambda: steps.append("work"), False) as result:
        steps.append("block")
        result()
    assert steps == ["work", "block"]


def test_work_of_a_copy_that_was_killed_is_done_by_the_program() -> None:
    program = os.getpid()

    def work() -> int:
        if os.getpid() != program:
            os.kill(os.getpid(), signal.SIGKILL)
        return os.getpid()

    with done_by_a_copy(work, True) as result:
        assert result() == program


def _fail() -> None:
    raise ValueError("what the recording lacks")


def test_an_error_of_the_work_is_raised_where_its_result_is_asked_for() -> None:
    with (
        done_by_a_copy(_fail, True) as result,
        pytest.raises(ValueError, match="what the recording lacks"),
    ):
        result()


def test_an_error_of_the_work_comes_before_one_of_the_block() -> None:
    with (
        pytest.raises(ValueError, match="what the recording lacks"),
        done_by_a_copy(_fail, True),
    ):
        raise RuntimeError("what follows from it")


def test_an_error_of_the_block_alone_is_its_own() -> None:
    with (
        pytest.raises(RuntimeError, match="of the block"),
        done_by_a_copy(os.getpid, True),
    ):
        raise RuntimeError("of the block")
