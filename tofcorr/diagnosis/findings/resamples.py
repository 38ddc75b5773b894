"""The resamples of the poses that every interval comes from."""

from collections.abc import Iterable, Sequence

import numpy as np
import torch
from torch import Tensor

from tofcorr.diagnosis.sums.study import Study

Interval = tuple[float, float]
TWO_SIDED = 1.96
"""Standard deviations of a normal distribution on either side that hold 95 %. A mathematical
constant."""
# Coverage of all intervals. The usual convention.
_LEVEL = 0.95
# Least standard error in a resample over that of all units, no unit. Chosen: a resample of few
# poses that happen to be alike would otherwise seem to know everything.
_LEAST_ERROR = 0.2


def draw_resamples(study: Study, generator: torch.Generator) -> Tensor:
    """Draw how often each resample holds each pose, shape (B, U)."""
    return resampled(study.system.blocks.num_units, study.options.bootstraps, generator)


def resampled(units: int, count: int, generator: torch.Generator) -> Tensor:
    """Draw how often each of some resamples holds each unit, shape (count, units)."""
    rows = []
    for _ in range(count):
        picked = torch.randint(0, units, (units,), generator=generator)
        rows.append(torch.bincount(picked, minlength=units).double())
    return torch.stack(rows)


def studentised(total: Tensor, count: Tensor, resamples: Tensor) -> Tensor:
    r"""Draw a ratio of sums over units from its studentised bootstrap (Efron and Tibshirani 1993).

    In a resample b the ratio differs from that of all units, r, by t_b standard errors of its own.
    The draws are

    .. math:: r - t_b \, \mathrm{se}(r) .

    With few units they reach farther than the ratios of the resamples, above all upwards, as they
    must: large squares are rare, and a sample without one seems more certain than it is.

    Args:
        total: Numerator of every unit, shape (U,).
        count: Denominator of every unit, shape (U,).
        resamples: How often each resample holds each unit, shape (B, U).

    Returns:
        Shape (B,).
    """
    whole = torch.ones_like(resamples[:1])
    ratio, error = _ratio(total, count, whole)
    own, own_error = _ratio(total, count, resamples)
    least = (_LEAST_ERROR * error).clamp(min=torch.finfo(total.dtype).tiny)
    return ratio - (own - ratio) * error / own_error.maximum(least)


def _ratio(total: Tensor, count: Tensor, weights: Tensor) -> tuple[Tensor, Tensor]:
    """Return ratios of weighted sums and their standard errors, shape (B,) each."""
    sums = (weights @ count).clamp(min=torch.finfo(total.dtype).tiny)
    ratio = (weights @ total) / sums
    deviations = total - ratio[:, None] * count
    freedom = len(total) / max(len(total) - 1, 1)
    return ratio, (freedom * (weights * deviations**2).sum(1)).sqrt() / sums


def interval_of(draws: Sequence[float], estimate: float) -> Interval:
    """Return the percentile interval, widened to contain the estimate."""
    low, high = np.quantile(list(draws), [(1 - _LEVEL) / 2, (1 + _LEVEL) / 2])
    return min(float(low), estimate), max(float(high), estimate)


def hull(intervals: Iterable[Interval]) -> Interval:
    """Return the least interval that contains all."""
    lows, highs = zip(*intervals, strict=True)
    return min(lows), max(highs)
