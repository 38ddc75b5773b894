r"""What each effect explains of the gap to a recalibrated simulator, by fits with and without it.

Beside the base model, which is always fitted again, the effects of a set S explain v(S) of the mean
square of its residual: what they lower it by, fitted without all others. The value of an effect is
its Shapley value, the mean of what it adds over all orders of the effects (Lindeman, Merenda and
Gold 1980). Effects that resemble one another share what either of them would explain. Coefficients
of one fit of all of them say less: they may be large and cancel, and the shares are then of any
size.
"""

from itertools import chain, combinations
from math import comb

import torch
from torch import Tensor

from tofcorr.diagnosis.findings.causes import Cause
from tofcorr.diagnosis.findings.parts import Parts


def values_beside_base(parts: Parts, weights: Tensor) -> Tensor:
    """Return the Shapley value of every effect in some resamples, shape (B, K), m^2.

    Args:
        parts: Columns and sums; all causes are effects.
        weights: How often each resample holds each pose, shape (B, U).
    """
    products = torch.tensordot(weights, parts.products, dims=1)
    count = len(parts.causes)
    every = range(count)
    left = {
        chosen: _left(parts, products, [parts.causes[k] for k in chosen])
        for chosen in chain.from_iterable(combinations(every, size) for size in range(count + 1))
    }
    values = torch.zeros(len(weights), count, dtype=torch.float64)
    for before, more in left.items():
        for effect in set(every) - set(before):
            less = left[tuple(sorted((*before, effect)))]
            values[:, effect] += (more - less) / (count * comb(count - 1, len(before)))
    return values / (weights @ parts.counts)[:, None]


def _left(parts: Parts, products: Tensor, causes: list[Cause]) -> Tensor:
    """Return the sum of squares that base model and some effects leave, shape (B,), m^2.

    Args:
        parts: Columns and sums.
        products: Of all columns and the residual in each resample, shape (B, Q, Q), m^2.
        causes: The effects.
    """
    fitted = [*parts.base, *chain.from_iterable(cause.members for cause in causes)]
    # The residual less what the effects add with a coefficient of one.
    rest = torch.zeros(products.shape[-1], dtype=torch.float64)
    rest[-1] = 1.0
    rest[[cause.fixed for cause in causes if cause.fixed is not None]] = -1.0
    right = products @ rest
    square, right = right @ rest, right[:, fitted]
    gram = products[:, fitted][:, :, fitted]
    theta = torch.linalg.solve(gram + parts.prior[fitted][:, fitted], right)
    return square - (theta * (2 * right - (gram @ theta[..., None])[..., 0])).sum(1)
