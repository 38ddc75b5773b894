"""Statistics of the scores: Wilson's interval, ranks, F1."""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

Z95 = 1.959963984540054


@dataclass(frozen=True)
class Share:
    """`hits` of `total`, with Wilson's 95 % interval (Wilson 1927)."""

    hits: int
    total: int

    @property
    def value(self) -> float:
        """The share; NaN of nothing."""
        return self.hits / self.total if self.total else math.nan

    @property
    def interval(self) -> tuple[float, float]:
        """Lower and upper limit; (0, 1) of nothing."""
        if not self.total:
            return 0.0, 1.0
        n, p = self.total, self.value
        middle = (p + Z95**2 / (2 * n)) / (1 + Z95**2 / n)
        half = Z95 / (1 + Z95**2 / n) * math.sqrt(p * (1 - p) / n + Z95**2 / (4 * n * n))
        return max(0.0, middle - half), min(1.0, middle + half)


def share(outcomes: Iterable[bool]) -> Share:
    """Count outcomes."""
    outcomes = list(outcomes)
    return Share(sum(outcomes), len(outcomes))


def auroc(positives: Sequence[float], negatives: Sequence[float]) -> float:
    """Probability that a positive scores above a negative, ties counting half; NaN without both."""
    if not len(positives) or not len(negatives):
        return math.nan
    difference = np.subtract.outer(np.asarray(positives, float), np.asarray(negatives, float))
    return float(np.mean((difference > 0) + 0.5 * (difference == 0)))


def auroc_interval(positives: Sequence[float], negatives: Sequence[float]) -> tuple[float, float]:
    """95 % limits of the AUROC by Hanley and McNeil's standard error (1982)."""
    a, m, n = auroc(positives, negatives), len(positives), len(negatives)
    if math.isnan(a):
        return 0.0, 1.0
    q1, q2 = a / (2 - a), 2 * a * a / (1 + a)
    error = math.sqrt(
        max(a * (1 - a) + (m - 1) * (q1 - a * a) + (n - 1) * (q2 - a * a), 0.0) / (m * n)
    )
    return max(0.0, a - Z95 * error), min(1.0, a + Z95 * error)


def macro_f1(
    truths: Sequence[set[str]], named: Sequence[set[str]], neutral: Sequence[set[str]]
) -> float:
    """Mean over effects of F1; what is `neutral` in a case counts neither for nor against.

    The mean runs over every effect that is true or named somewhere.
    """
    hits: dict[str, int] = {}
    misses: dict[str, int] = {}
    for true, said, free in zip(truths, named, neutral, strict=True):
        for name in true & said:
            hits[name] = hits.get(name, 0) + 1
        for name in (true ^ said) - free:
            misses[name] = misses.get(name, 0) + 1
    effects = hits.keys() | misses.keys()
    if not effects:
        return math.nan
    return float(
        np.mean([2 * hits.get(e, 0) / (2 * hits.get(e, 0) + misses.get(e, 0)) for e in effects])
    )


def quantile_interval(values: Sequence[float], q: float) -> tuple[float, float, float]:
    """A quantile with 95 % limits from order statistics (binomial); NaN of nothing."""
    if not len(values):
        return math.nan, math.nan, math.nan
    ordered = np.sort(np.asarray(values, float))
    n = len(ordered)
    half = Z95 * math.sqrt(n * q * (1 - q))
    low, high = max(math.floor(n * q - half), 0), min(math.ceil(n * q + half), n - 1)
    return float(np.quantile(ordered, q)), float(ordered[low]), float(ordered[high])
