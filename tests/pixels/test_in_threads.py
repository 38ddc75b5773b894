"""Work by several threads gives what one thread gives, in order."""

from collections.abc import Iterator

import pytest
import torch
from threadpoolctl import threadpool_info, threadpool_limits

from tofcorr.pixels.in_threads import in_threads


def test_results_come_in_the_order_of_the_items_and_torch_computes_each_alone() -> None:
    before = torch.get_num_threads()
    found = list(in_threads(lambda k: (k * k, torch.get_num_threads()), range(20), threads=3))
    assert found == [(k * k, 1) for k in range(20)]
    assert torch.get_num_threads() == before


def test_numpy_computes_each_item_alone_and_as_before_afterwards() -> None:
    def number(_: int) -> set[int]:
        return {library["num_threads"] for library in threadpool_info() if is_blas(library)}

    def is_blas(library: dict[str, object]) -> bool:
        return library["user_api"] == "blas"

    with threadpool_limits(2, user_api="blas"):
        before = number(0)
        assert set().union(*in_threads(number, range(4), threads=2)) == {1}
        assert number(0) == before


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


def test_a_failure_in_a_thread_is_that_of_the_caller() -> None:
    def fail(k: int) -> int:
        if k == 3:
            raise ValueError("the fourth")
        return k

    with pytest.raises(ValueError, match="the fourth"):
        list(in_threads(fail, range(9), threads=2))


def test_whether_gradients_are_kept_is_the_callers_choice() -> None:
    with torch.no_grad():
        assert not any(in_threads(lambda _: torch.is_grad_enabled(), range(4), threads=2))
