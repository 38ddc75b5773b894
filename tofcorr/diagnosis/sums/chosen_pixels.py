"""Which pixels of a large image are diagnosed."""

import torch
from torch import Tensor

# Inverse of the plastic ratio. Multiples of it and of its square fill the square most evenly, as
# those of the golden ratio fill a line (Roberts 2018, "The unreasonable effectiveness of
# quasirandom sequences"). Derived: the real root of x^3 + x^2 = 1.
_PLASTIC = 0.7548776662466927


def thinned(usable: Tensor, budget: int, rank: Tensor) -> Tensor:
    """Keep at most `budget` of the usable pixels: those of the lowest rank."""
    if len(usable) <= budget:
        return usable
    first = rank[usable].topk(budget, largest=False, sorted=False).indices
    return usable[first].sort().values


def ranks(height: int, width: int) -> Tensor:
    """Return in which order the pixels of an image are chosen, shape (H W,), int64.

    The first ones of any number are spread evenly, and are the same in all frames: an error of each
    pixel of its own shows only in a pixel that several poses see.
    """
    rows, columns = torch.arange(height)[:, None], torch.arange(width)
    place = (rows * _PLASTIC + columns * _PLASTIC**2).remainder(1.0)
    return place.reshape(-1).argsort(stable=True).argsort()
