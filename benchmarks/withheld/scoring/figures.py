"""One figure of the table, and the kinds of figures there are."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from benchmarks.withheld.outcomes import Outcome
from benchmarks.withheld.statistics import Share, quantile_interval


@dataclass(frozen=True)
class Score:
    """A figure with its 95 % limits, the cases behind it, and the target it meets or misses."""

    tier: str
    what: str
    value: float
    interval: tuple[float, float]
    count: int
    target: str = ""
    met: bool | None = None


def share_score(tier: str, what: str, counted: Share, at_least: float | None = None) -> Score:
    """A share with Wilson's interval."""
    met = None if at_least is None else counted.value >= at_least
    return Score(
        tier, what, counted.value, counted.interval, counted.total, target_text(at_least), met
    )


def mean_score(tier: str, what: str, values: Sequence[float], at_most: float) -> Score:
    """A mean with normal limits."""
    if not values:
        return Score(tier, what, math.nan, (math.nan, math.nan), 0, f"≤ {at_most}", False)
    mean, error = float(np.mean(values)), float(np.std(values) / math.sqrt(len(values)))
    return Score(
        tier,
        what,
        mean,
        (mean - 1.96 * error, mean + 1.96 * error),
        len(values),
        f"≤ {at_most}",
        mean <= at_most,
    )


def quantile_score(
    tier: str, what: str, values: Sequence[float], q: float, at_least: float | None = None
) -> Score:
    """A quantile with binomial limits."""
    value, low, high = quantile_interval(values, q)
    return Score(
        tier,
        what,
        value,
        (low, high),
        len(values),
        target_text(at_least),
        None if at_least is None else value >= at_least,
    )


def bootstrap(
    cases: Sequence[Outcome], statistic: Callable[[Sequence[Outcome]], float]
) -> tuple[float, float]:
    """95 % percentile limits over resampled cases."""
    if not cases:
        return math.nan, math.nan
    rng = np.random.default_rng(0)
    draws = [
        statistic([cases[i] for i in rng.integers(len(cases), size=len(cases))]) for _ in range(400)
    ]
    low, high = np.nanquantile(draws, [0.025, 0.975])
    return float(low), float(high)


def target_text(at_least: float | None) -> str:
    """How a lower target is written."""
    return "" if at_least is None else f"≥ {at_least}"
