"""The figures of the check, each with its interval and, where the issue sets one, its target."""

from collections.abc import Callable, Sequence
from pathlib import Path

from benchmarks.renewed.remains import true_gaps
from benchmarks.withheld.outcomes import Outcome
from benchmarks.withheld.scoring.figures import Score, mean_score, share_score
from benchmarks.withheld.statistics import Share, share

LEAST_MM = 2.0  # smaller effects are not asked for
MANY = 25  # poses: recordings with as many are also counted by themselves
NAMED_FALSELY = (0.03, 0.07)  # share of recordings with nothing missing; so for "unknown"
COVERAGE = (0.92, 0.98)  # of 95 % intervals
PART_OF = {"backlash": "robot_kinematics"}  # by what wider name the check knows such an effect
FIGURES = {"before": "before_ci", "after": "after_ci", "closed_fraction": "closed_ci"}

Judge = Callable[[Outcome], bool]


def findable(outcomes: Sequence[Outcome]) -> list[Outcome]:
    """Cases of one effect of 2 mm or more that an oracle with the true form finds."""
    found = [one for one in outcomes if one.tier == "E" and one.must_find]
    return [one for one in found if one.answer["sizes_mm"][one.truth] >= LEAST_MM]


def wrong(one: Outcome) -> bool:
    """Whether a set of one effect names one that is not there."""
    return any(len(known) == 1 and not known & one.truths for known in _known(one))


def right(one: Outcome) -> bool:
    """Whether the true effect is in a set."""
    return any(one.truth in known for known in _known(one))


def _known(one: Outcome) -> list[set[str]]:
    """The sets named, in the names that the check uses."""
    return [{PART_OF.get(name, name) for name in members} for members in one.said.sets]


def right_or_unknown(one: Outcome) -> bool:
    """Whether the true effect is in a set, or the cause is called unknown."""
    return right(one) or one.said.unknown


def many_poses(one: Outcome) -> bool:
    """Whether a recording has more poses than an afternoon gives."""
    return one.answer["case"]["design"]["poses"] >= MANY


def textbook(one: Outcome) -> bool:
    """Whether the effect has the form that the literature writes first."""
    return bool(one.answer["case"]["textbook"])


def score_all(outcomes: Sequence[Outcome], out: Path) -> list[Score]:
    """All figures, without those of single effects and forms."""
    cases = findable(outcomes)
    other = [one for one in cases if not textbook(one)]
    nulls = [one for one in outcomes if one.tier == "N"]
    enough = [one for one in nulls if many_poses(one)]
    outside = [one for one in outcomes if one.tier == "O" and one.must_find]
    scores = [
        *_one_effect("findable", cases),
        *_one_effect("textbook form", [one for one in cases if textbook(one)]),
        *_other_form("other form", other),
        *_one_effect("25 poses or more", [one for one in cases if many_poses(one)]),
        *_other_form("outside", outside, named=False),
        *_nothing("nothing", nulls),
        *_nothing("nothing, 25 poses", enough),
        *_coverage("all", [one for one in outcomes if one.tier in "ENO"], out),
        *_coverage("one effect", cases, out),
        *_coverage("nothing", nulls, out),
        *_real([one for one in outcomes if one.tier == "K"]),
    ]
    failed = share(bool(one.said.failure) for one in outcomes)
    return [one for one in [*scores, share_score("all", "runs that failed", failed)] if one.count]


def _one_effect(title: str, cases: Sequence[Outcome]) -> list[Score]:
    sizes = [float(len(one.said.sets[0])) for one in cases if one.said.sets]
    return [
        share_score(title, "in the set", count(cases, right), 0.90),
        within(title, "a single wrong name", count(cases, wrong), (0.0, 0.05)),
        mean_score(title, "size of the set", sizes, at_most=1.8),
        *_said(title, cases),
    ]


def _other_form(title: str, cases: Sequence[Outcome], named: bool = True) -> list[Score]:
    judge = right_or_unknown if named else lambda one: one.said.unknown
    what = "in the set or unknown" if named else "unknown"
    return [
        share_score(title, what, count(cases, judge), 0.90 if named else None),
        within(title, "a single wrong name", count(cases, wrong), (0.0, 0.08)),
        *_said(title, cases),
    ]


def _said(title: str, cases: Sequence[Outcome]) -> list[Score]:
    return [
        share_score(title, "something named", count(cases, lambda one: bool(one.said.effects))),
        share_score(title, "called unknown", count(cases, lambda one: one.said.unknown)),
        share_score(title, "neither", count(cases, silent)),
    ]


def silent(one: Outcome) -> bool:
    """Whether nothing was named and nothing called unknown."""
    return not one.said.effects and not one.said.unknown


def _nothing(title: str, cases: Sequence[Outcome]) -> list[Score]:
    return [
        within(title, "named", count(cases, lambda one: bool(one.said.effects)), NAMED_FALSELY),
        within(title, "unknown", count(cases, lambda one: one.said.unknown), NAMED_FALSELY),
        within(title, "detected", count(cases, detected), (0.0, 0.10)),
    ]


def detected(one: Outcome) -> bool:
    """Whether the report says that a gap was detected."""
    return bool(one.said.report.get("detected"))


def _coverage(title: str, cases: Sequence[Outcome], out: Path) -> list[Score]:
    held: dict[str, list[bool]] = {name: [] for name in FIGURES}
    for one in cases:
        for name, inside in covered(one, out).items():
            held[name].append(inside)
    return [
        within(title, f"95 % interval of {name} holds the truth", share(found), COVERAGE)
        for name, found in held.items()
    ]


def covered(one: Outcome, out: Path) -> dict[str, bool]:
    """Whether each interval of a report holds the truth; empty where that was not measured.

    A report without an interval does not hold it.
    """
    before, after = true_gaps(one, out)
    if before is None:
        return {}
    true = {"before": before}
    if after is not None:
        true |= {"after": after, "closed_fraction": 1 - (after / before) ** 2}
    gaps = one.said.report["gap_mm"]
    return {name: _holds(gaps.get(FIGURES[name]), value) for name, value in true.items()}


def _holds(interval: Sequence[float | None] | None, value: float) -> bool:
    if not interval or None in interval:
        return False
    low, high = interval
    return low <= value <= high  # type: ignore[operator]


def _real(cases: Sequence[Outcome]) -> list[Score]:
    """Real recordings: what is named of what was added, beside what they show as they are."""
    added = [one for one in cases if one.role == "added"]
    own = {
        (one.answer["case"]["source"], name)
        for one in cases
        if one.role == "plain"
        for name in one.said.effects
    }

    def strange(one: Outcome) -> bool:
        source = one.answer["case"]["source"]
        return any((source, name) not in own for name in set(one.said.effects) - one.truths)

    return [
        share_score("real", "added effect in the set", count(added, right)),
        share_score("real", "added effect in the set or unknown", count(added, right_or_unknown)),
        share_score("real", "named though neither added nor seen before", count(added, strange)),
    ]


def count(cases: Sequence[Outcome], judge: Judge) -> Share:
    """Count the cases judged true."""
    return share(judge(one) for one in cases)


def within(title: str, what: str, counted: Share, limits: tuple[float, float]) -> Score:
    """A share with Wilson's interval and two targets."""
    low, high = limits
    target = f"{low}–{high}" if low else f"≤ {high}"
    met = low <= counted.value <= high
    return Score(title, what, counted.value, counted.interval, counted.total, target, met)
