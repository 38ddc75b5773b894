"""The checks of annotated shapes in a test run: of every call that differs from all before it.

Whether a call keeps its annotations follows from the types and shapes of its arrays, and from the
other arguments themselves. A call that agrees in all of them with one that passed is not looked at
again: most calls of a fit are such, and beartype takes four times as long for each.
"""

from collections.abc import Callable
from functools import wraps
from typing import Any

import torch
from beartype import beartype

# Calls that are remembered of each function: more than a test run has, so that memory is bounded.
_MOST_REMEMBERED = 10_000


def checked(function: Callable[..., Any]) -> Callable[..., Any]:
    """Return what jaxtyping calls to check arguments and results: beartype, but once for each."""
    strict: Callable[..., Any] = beartype(function)
    passed: set[Any] = set()

    @wraps(function)
    def check(*args: Any, **named: Any) -> Any:
        key = (*map(_looks, args), *named, *map(_looks, named.values()))
        if key not in passed:
            strict(*args, **named)
            if len(passed) >= _MOST_REMEMBERED:
                passed.clear()
            passed.add(key)

    return check


def _looks(value: Any) -> Any:
    """Return what of an argument an annotation can depend on; of other objects their identity."""
    if isinstance(value, torch.Tensor):
        return type(value), value.shape, value.dtype
    if value is None or type(value) in (bool, int, float, str):
        return type(value), value
    return type(value), id(value)
