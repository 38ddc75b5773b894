"""Smooth functions of one variable at many places, from a table."""

from collections.abc import Callable

import torch
from torch import Tensor

# A table pays where it has fewer than this share of the places (no unit). Measured: a place of the
# table costs as much as four that are looked up.
_LARGEST_TABLE = 0.1


def interpolated(function: Callable[[Tensor], Tensor], at: Tensor, step: float) -> Tensor:
    """Return a function's values, linear between places of a table; like `at`.

    Where derivatives are wanted, and where the table would be large, the function itself is called.

    Args:
        function: Takes places of any shape and returns as many values; NaN at NaN.
        at: Where it is wanted, of any shape.
        step: Of the table. The error is at most an eighth of its square times the second
            derivative.
    """
    if (
        not at.numel()
        or at.dtype != torch.float32
        or (torch.is_grad_enabled() and at.requires_grad)
    ):
        return function(at)
    known = at.nan_to_num()
    low, high = (float(end) for end in known.aminmax())
    count = int(min((high - low) / step, known.numel())) + 3  # The last place may be rounded up.
    if count > _LARGEST_TABLE * known.numel():
        return function(at)
    places = low + step * torch.arange(count, dtype=torch.float64, device=at.device)
    values = function(places)
    known.sub_(low).mul_(1 / step)
    index = known.to(torch.int32)
    part = known.sub_(index).flatten()
    index = index.flatten()
    own, rise = values[:-1].float(), values.diff().float()
    found = torch.addcmul(own.index_select(0, index), part, rise.index_select(0, index))
    return torch.where(at.isnan(), at, found.view_as(at))
