"""Scores: shares with Wilson's interval, means, quantiles, areas; and what is judged of a case."""

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, TypeVar

import numpy as np
from scipy.stats import binomtest, mannwhitneyu, norm

from benchmarks.sealed.answers import Outcome, contradictions

Case = TypeVar("Case")
Values = Sequence[float]
Limits = tuple[float, float]
Targets = Mapping[str, Limits]
ANY = (-math.inf, math.inf)  # no target

LEAST_MM = 2.0  # smaller effects are not asked for
PART_OF = {"backlash": "robot_kinematics"}  # by what wider name the checks know such an effect


@dataclass(frozen=True)
class Score:
    """A figure with its 95 % limits, the cases behind it, and the target that it should meet."""

    tier: str
    what: str
    value: float
    interval: Limits
    count: int
    target: Limits = ANY

    @property
    def wanted(self) -> str:
        """The target in words."""
        low, high = self.target
        if math.isinf(low):
            return "" if math.isinf(high) else f"≤ {high:g}"
        return f"≥ {low:g}" if math.isinf(high) else f"{low:g}–{high:g}"

    @property
    def met(self) -> str:
        """Whether it is met, in a word."""
        low, high = self.target
        return ("met" if low <= self.value <= high else "missed") if self.wanted else ""


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
    def interval(self) -> Limits:
        """Lower and upper limit; (0, 1) of nothing."""
        if not self.total:
            return 0.0, 1.0
        found = binomtest(self.hits, self.total).proportion_ci(method="wilson")
        return float(found.low), float(found.high)

    def __str__(self) -> str:
        """The share as a table shows it."""
        low, high = self.interval
        return f"{self.value:.3f} [{low:.3f}, {high:.3f}]"


def share(outcomes: Iterable[bool | None]) -> Share:
    """Count outcomes; None was not measured."""
    judged = [one for one in outcomes if one is not None]
    return Share(sum(judged), len(judged))


def share_score(tier: str, what: str, judged: Iterable[bool | None], target: Limits = ANY) -> Score:
    """The share of the cases judged true among those that can be judged."""
    counted = share(judged)
    return Score(tier, what, counted.value, counted.interval, counted.total, target)


def at_least(limit: float) -> Limits:
    """A lower target."""
    return limit, math.inf


def at_most(limit: float) -> Limits:
    """An upper target."""
    return -math.inf, limit


def mean_score(tier: str, what: str, values: Values, target: Limits) -> Score:
    """A mean with normal limits."""
    mean = float(np.mean(values)) if values else math.nan
    half = float(norm.ppf(0.975) * np.std(values) / math.sqrt(len(values))) if values else math.nan
    return Score(tier, what, mean, (mean - half, mean + half), len(values), target)


def quantile_score(tier: str, what: str, values: Values, q: float, target: Limits) -> Score:
    """A quantile with 95 % limits from order statistics (binomial)."""
    if not values:
        return Score(tier, what, math.nan, (math.nan, math.nan), 0, target)
    ordered, n = np.sort(values), len(values)
    half = norm.ppf(0.975) * math.sqrt(n * q * (1 - q))
    low, high = max(math.floor(n * q - half), 0), min(math.ceil(n * q + half), n - 1)
    limits = float(ordered[low]), float(ordered[high])
    return Score(tier, what, float(np.quantile(ordered, q)), limits, n, target)


def area_score(tier: str, what: str, positives: Values, negatives: Values, target: Limits) -> Score:
    """Area under the ROC curve, with Hanley and McNeil's standard error (1982)."""
    m, n = len(positives), len(negatives)
    if not m or not n:
        return Score(tier, what, math.nan, (0.0, 1.0), m, target)
    a = float(mannwhitneyu(positives, negatives).statistic) / (m * n)
    q1, q2 = a / (2 - a), 2 * a * a / (1 + a)
    square = a * (1 - a) + (m - 1) * (q1 - a * a) + (n - 1) * (q2 - a * a)
    half = float(norm.ppf(0.975)) * math.sqrt(max(square, 0.0) / (m * n))
    return Score(tier, what, a, (max(0.0, a - half), min(1.0, a + half)), m, target)


def macro_f1(cases: Sequence[Outcome]) -> float:
    """Mean over effects of F1; true effects that cannot be found count neither for nor against."""
    names = sorted({name for one in cases for name in (*one.truths, *one.said.effects)})
    scores = []
    for name in names:
        judged = [one for one in cases if name not in one.truths - one.must_find]
        true = sum(name in one.must_find for one in judged)
        said = [one for one in judged if name in one.said.effects]
        hits = sum(name in one.must_find for one in said)
        scores += [2 * hits / (true + len(said))] if true or said else []
    return float(np.mean(scores)) if scores else math.nan


def bootstrap(cases: Sequence[Case], statistic: Callable[[Sequence[Case]], float]) -> Limits:
    """95 % percentile limits over resampled cases."""
    if not cases:
        return math.nan, math.nan
    rng = np.random.default_rng(0)
    draws = [[cases[i] for i in rng.integers(len(cases), size=len(cases))] for _ in range(400)]
    low, high = np.nanquantile([statistic(draw) for draw in draws], [0.025, 0.975])
    return float(low), float(high)


# What is judged of a case.


def known(names: Iterable[str]) -> frozenset[str]:
    """Names in those that the checks use."""
    return frozenset(PART_OF.get(name, name) for name in names)


def covers(one: Outcome, name: str) -> bool:
    """Whether an effect is in a set."""
    return any(name in members for members in map(known, one.said.sets))


def wrong(one: Outcome) -> bool:
    """Whether a set of one effect names one that is not there."""
    sets = map(known, one.said.sets)
    return any(len(members) == 1 and not members & one.truths for members in sets)


def named(one: Outcome) -> bool:
    """Whether an effect is named."""
    return bool(one.said.effects)


def named_first(one: Outcome) -> bool:
    """Whether a true effect is the first one named."""
    return bool(known(one.said.effects[:1]) & one.truths)


def unknown(one: Outcome) -> bool:
    """Whether the cause is called unknown."""
    return one.said.unknown


def silent(one: Outcome) -> bool:
    """Whether nothing was named and nothing called unknown."""
    return not named(one) and not unknown(one)


def detected(one: Outcome) -> bool:
    """Whether the report says that a gap was detected."""
    return bool(one.said.report.get("detected"))


NEW_NAME = "named though neither added nor seen before"


def names_something_new(cases: Iterable[Outcome]) -> Callable[[Outcome], bool]:
    """Whether an effect is named that is neither true nor named of the plain real images."""
    own = {name for one in cases if one.role == "plain" for name in one.said.effects}
    return lambda one: bool(set(one.said.effects) - one.truths - own)


def figures(title: str, cases: Sequence[Outcome], targets: Targets | None = None) -> list[Score]:
    """What is said of cases: of effects that an oracle finds, and where nothing is missing."""
    find = [one for one in cases if one.must_find]
    nulls = [one for one in cases if not one.truths]
    effects = [(one, name) for one in find for name in sorted(one.must_find)]
    held = [covers(one, name) for one, name in effects]
    either = [a or unknown(one) for a, (one, _) in zip(held, effects, strict=True)]
    judged: dict[str, Iterable[bool]] = {
        "in the set": held,
        "in the set or unknown": either,
        "named first": map(named_first, find),
        "something named": map(named, find),
        "called unknown": map(unknown, find),
        "neither": map(silent, find),
        "a single wrong name": map(wrong, cases),
        "named though nothing is there": map(named, nulls),
        "called unknown though nothing is there": map(unknown, nulls),
        "detected though nothing is there": map(detected, nulls),
        "a report that contradicts itself": [
            bool(contradictions(one.said.report))
            for one in cases
            if "set_probabilities" in one.said.report
        ],
    }
    wanted, sizes = targets or {}, [float(len(one.said.sets[0])) for one in find if one.said.sets]
    scores = [share_score(title, k, some, wanted.get(k, ANY)) for k, some in judged.items()]
    size = "size of the set"
    return [*scores, mean_score(title, size, sizes, wanted.get(size, ANY))]


def table(head: Sequence[str], rows: Iterable[Sequence[object]]) -> str:
    """A table in Markdown."""
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join("| " + " | ".join(str(cell) for cell in line) + " |" for line in lines)


DESIGNS: dict[str, Callable[[Any], str]] = {
    "frames": lambda case: _bin(case["design"]["frames"], (30, 60, 120)),
    "poses": lambda case: _bin(case["design"]["poses"], (8, 16, 32, 48)),
    "image": lambda case: f"{case['sensor']['width']}×{case['sensor']['height']}",
    "robot, mm": lambda case: _bin(1e3 * case["design"]["robot"], (0.3, 0.6, 1.2)),
    "farthest, m": lambda case: _bin(case["design"]["far"], (1, 2, 4)),
    "mask": lambda case: case["design"]["mask"],
    "scene": lambda case: case["design"]["scene"],
    "repeats": lambda case: "yes" if case["design"]["repeated"] else "no",
    "spatial filter": lambda case: case["sensor"]["spatial_filter"],
    "temporal filter": lambda case: str(case["sensor"]["temporal_filter"]),
    "rounding, mm": lambda case: f"{case['sensor']['rounding_mm']:g}",
    "sun": lambda case: "yes" if case["sensor"]["sun"] else "no",
    "frequencies": lambda case: str(len(case["sensor"]["frequencies"])),
}
"""What is drawn of a case, in words."""


def by_design(cases: Sequence[tuple[Mapping[str, Any], Sequence[bool]]]) -> list[tuple[Any, ...]]:
    """Rows that count what was judged of cases, for all that have the same in common."""
    rows = []
    for what, of in DESIGNS.items():
        for value in sorted({of(case) for case, _ in cases}):
            some = [judged for case, judged in cases if of(case) == value]
            rows.append((what, value, len(some), *map(sum, zip(*some, strict=True))))
    return rows


def _bin(value: float, edges: Sequence[float]) -> str:
    low = [edge for edge in edges if edge <= value]
    high = [edge for edge in edges if edge > value]
    if not high:
        return f"{low[-1]:g} or more"
    return f"below {high[0]:g}" if not low else f"{low[-1]:g} to {high[0]:g}"


def scores_table(scores: Iterable[Score]) -> str:
    """All figures as one table."""
    rows = []
    for one in scores:
        value = "{:.2f} [{:.2f}, {:.2f}]".format(one.value, *one.interval)
        rows += [(one.tier, one.what, value, one.count, one.wanted, one.met)] if one.count else []
    return table(("recordings", "figure", "value", "n", "wanted", ""), rows)
