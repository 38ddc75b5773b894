"""Charge that runs from full pixels along a line of the sensor (blooming)."""

import math

import torch
from torch import Tensor

# Pixels over which the charge falls by e, and how far it is followed. Set by hand: blooming of
# small pixels reaches a few of them.
_LENGTH_PX = 2.0
_REACH_PX = 4


def spilled(over: Tensor, axis: int) -> Tensor:
    """Return the charge that each pixel receives from the others on its line, like `over`.

    A pixel gives all that it has too much to its neighbours, equally to both sides and falling by
    e over two pixels. What would run beyond the edge of the image is lost.

    Args:
        over: Charge above the full level, of any shape, not negative.
        axis: The axis along which it runs.
    """
    count = over.shape[axis]
    weights = [math.exp(-place / _LENGTH_PX) for place in range(1, _REACH_PX + 1)]
    received = torch.zeros_like(over)
    for place, weight in enumerate(weights, start=1):
        if place >= count:
            break
        first, last = over.narrow(axis, 0, count - place), over.narrow(axis, place, count - place)
        share = weight / (2 * sum(weights))
        received.narrow(axis, place, count - place).add_(first, alpha=share)
        received.narrow(axis, 0, count - place).add_(last, alpha=share)
    return received
