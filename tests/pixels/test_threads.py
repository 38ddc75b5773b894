"""Work by several threads gives what one gives, in order; the caller's number stands afterwards."""

from collections.abc import Iterator

import pytest
import torch
from threadpoolctl import threadpool_info, threadpool_limits

from tofcorr.pixels.dataset import in_threads, thread_number, threads_at_once


@pytest.fixture(autouse=True)
def three_threads() -> Iterator[None]:
    before = torch.get_num_threads()
    torch.set_num_threads(3)
    yield
    assert torch.get_num_threads() == 3
    torch.set_num_threads(before)


def _of_products(_: object = None) -> set[int]:
    return {one["num_threads"] for one in threadpool_info() if one["user_api"] == "blas"}


@pytest.mark.parametrize(("asked", "used"), [(1, 1), (2, 2), (None, 3)])
def test_the_number_holds_inside_and_the_callers_own_after(asked: int | None, used: int) -> None:
    with thread_number(asked), thread_number(None):
        assert (torch.get_num_threads(), threads_at_once()) == (used, 3)
    with pytest.raises(ZeroDivisionError), thread_number(asked):
        _ = 1 / 0


def test_results_come_in_the_order_of_the_items_and_each_is_computed_alone() -> None:
    found = in_threads(lambda k: (k * k, torch.get_num_threads()), range(20), threads=3)
    assert list(found) == [(k * k, 1) for k in range(20)]
    with threadpool_limits(2, user_api="blas"):
        before = _of_products()
        assert set().union(*in_threads(_of_products, range(4), threads=2)) == {1}
        assert _of_products() == before


def test_few_items_are_read_ahead() -> None:
    read = []

    def items() -> Iterator[int]:
        for k in range(50):
            read.append(k)
            yield k

    results = in_threads(lambda k: k, items(), threads=2)
    assert next(results) == 0
    assert len(read) == 3
    results.close()  # type: ignore[attr-defined]


def test_failures_and_the_choice_of_gradients_are_the_callers() -> None:
    with pytest.raises(ZeroDivisionError):
        list(in_threads(lambda k: 1 / (k - 3), range(9), threads=2))
    with torch.no_grad():
        assert not any(in_threads(lambda _: torch.is_grad_enabled(), range(4), threads=2))
