"""The resamples of the poses that every interval comes from."""

from collections.abc import Iterable, Sequence

import numpy as np
import torch
from torch import Tensor

from tofcorr.diagnosis.sums.study import Study

Interval = tuple[float, float]
# Coverage of all intervals. The usual convention.
_LEVEL = 0.95


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


def interval_of(draws: Sequence[float], estimate: float) -> Interval:
    """Return the percentile interval, widened to contain the estimate."""
    low, high = np.quantile(list(draws), [(1 - _LEVEL) / 2, (1 + _LEVEL) / 2])
    return min(float(low), estimate), max(float(high), estimate)


def hull(intervals: Iterable[Interval]) -> Interval:
    """Return the least interval that contains all."""
    lows, highs = zip(*intervals, strict=True)
    return min(lows), max(highs)
