"""Tiers whose effect the catalogue has, or in which there is none: A, B, C, H, I, J."""

from collections.abc import Sequence

from benchmarks.withheld.outcomes import Outcome, exact, findable, main_of, named_first
from benchmarks.withheld.scoring.detection import detectable
from benchmarks.withheld.scoring.figures import (
    Score,
    bootstrap,
    mean_score,
    quantile_score,
    share_score,
)
from benchmarks.withheld.statistics import macro_f1, share

BASE_TERMS = {  # what a base of the wrong form is rightly called
    "smooth": frozenset[str](),
    "distance": frozenset({"distance", "wiggling"}),
    "pixel": frozenset({"pixel", "fixed_pattern"}),
    "amplitude": frozenset({"amplitude"}),
}


def single(outcomes: Sequence[Outcome]) -> list[Score]:
    """Tier A: one effect."""
    cases = findable(main_of(outcomes, "A"))
    named = [one for one in cases if one.said.effects]
    sizes = [len(one.said.sets[0]) for one in named if one.said.sets]
    return [
        share_score("A", "named first, of those findable", share(map(named_first, cases)), 0.85),
        share_score(
            "A",
            "in the set, of those findable",
            share(one.covered(one.truth) for one in cases),
            0.95,
        ),
        mean_score("A", "size of the set", sizes, at_most=1.5),
        share_score(
            "A",
            "something named, of those findable",
            share(bool(one.said.effects) for one in cases),
        ),
        share_score(
            "A", "named first, of those with something named", share(map(named_first, named))
        ),
        share_score("A", "exactly the true effect", share(map(exact, cases))),
        *_shrinkage(cases),
        *_coverage(outcomes),
        *detectable(outcomes),
    ]


def _shrinkage(cases: Sequence[Outcome]) -> list[Score]:
    """Closed squared gap over what the oracle closes, where something was named and everywhere."""
    ratios = [_closed_ratio(one) for one in cases]
    named = [ratio for ratio, one in zip(ratios, cases, strict=True) if one.said.effects]
    return [
        quantile_score("A", "shrinkage against the oracle, median", named, 0.5, 0.90),
        quantile_score("A", "shrinkage against the oracle, 10th percentile", named, 0.1, 0.60),
        quantile_score("A", "the same, nothing named counting as none closed: median", ratios, 0.5),
        quantile_score(
            "A", "the same, nothing named counting as none closed: 10th percentile", ratios, 0.1
        ),
    ]


def _closed_ratio(one: Outcome) -> float:
    if not one.said.effects:
        return 0.0
    return float(one.said.report["gap_mm"]["closed_fraction"]) / one.oracle.plain.closed_fraction


def _coverage(outcomes: Sequence[Outcome]) -> list[Score]:
    """Whether the interval of the closed share holds what a fresh session shows."""
    fresh = {one.answer["main"]: one for one in outcomes if one.role == "fresh"}
    pairs = [
        (one, fresh[one.name])
        for one in main_of(outcomes, "A")
        if one.name in fresh and one.said.effects
    ]
    same = [
        (one, again) for one, again in pairs if set(one.said.effects) == set(again.said.effects)
    ]
    true_form = [(one, again) for one, again in pairs if set(one.said.effects) == {one.truth}]
    return [
        share_score(
            "A",
            "intervals of the closed share that hold what a fresh session shows",
            share(
                _holds(one, again.said.report["gap_mm"]["closed_fraction"]) for one, again in same
            ),
            0.90,
        ),
        share_score(
            "A",
            "intervals of the closed share that hold what the oracle closes in the fresh session",
            share(_holds(one, again.oracle.plain.closed_fraction) for one, again in true_form),
        ),
    ]


def _holds(one: Outcome, value: float) -> bool:
    low, high = one.said.report["gap_mm"]["closed_ci"]
    return low <= value <= high


def several(outcomes: Sequence[Outcome]) -> list[Score]:
    """Tier B: two or three effects."""
    cases = main_of(outcomes, "B")
    f1 = _macro(cases)
    spread = bootstrap(cases, _macro)
    wanted = [(one, name) for one in cases for name in sorted(one.must_find)]
    named = [(one, name) for one in cases for name in one.said.effects]
    return [
        Score("B", "macro-F1", f1, spread, len(cases), "≥ 0.75", f1 >= 0.75),
        share_score(
            "B",
            "named, of the effects findable",
            share(name in one.said.effects for one, name in wanted),
        ),
        share_score(
            "B",
            "in a set, of the effects findable",
            share(one.covered(name) for one, name in wanted),
        ),
        share_score(
            "B", "true, of the effects named", share(name in one.truths for one, name in named)
        ),
        share_score("B", "exactly the true effects", share(map(exact, cases))),
    ]


def _macro(cases: Sequence[Outcome]) -> float:
    return macro_f1(
        [set(one.must_find) for one in cases],
        [set(one.said.effects) for one in cases],
        [set(one.truths - one.must_find) for one in cases],
    )


def nothing(outcomes: Sequence[Outcome]) -> list[Score]:
    """Tier C: no effect, or one of 0.2 mm."""
    nulls = [one for one in main_of(outcomes, "C") if not one.truths]
    nearly = [one for one in main_of(outcomes, "C") if one.truths]
    false = share(bool(one.said.effects) for one in nulls)
    high = false.interval[1]
    return [
        Score(
            "C",
            "an effect named though none is there",
            false.value,
            false.interval,
            false.total,
            "upper limit ≤ 0.08",
            high <= 0.08,
        ),
        share_score(
            "C",
            "a false effect named beside one of 0.2 mm",
            share(not set(one.said.effects) <= one.truths for one in nearly),
        ),
        share_score(
            "C",
            "gap called detected though there is none",
            share(bool(one.said.report.get("detected")) for one in nulls),
        ),
        share_score(
            "C", "called unknown though there is nothing", share(one.said.unknown for one in nulls)
        ),
    ]


def few_frames(outcomes: Sequence[Outcome]) -> list[Score]:
    """Tier H: fewer frames."""
    scores = []
    for frames in (15, 30, 60):
        cases = findable(
            one
            for one in main_of(outcomes, "H")
            if one.answer["case"]["design"]["frames"] == frames
        )
        named = [one for one in cases if one.said.effects]
        scores += [
            share_score(
                "H",
                f"{frames} frames: something named, of those findable",
                share(bool(one.said.effects) for one in cases),
            ),
            share_score(
                "H", f"{frames} frames: named first, of those named", share(map(named_first, named))
            ),
        ]
    return scores


def other_noise(outcomes: Sequence[Outcome]) -> list[Score]:
    """Tier I: noise of another kind."""
    cases = main_of(outcomes, "I")
    nulls, effects = [one for one in cases if not one.truths], findable(cases)
    kinds = sorted({one.answer["case"]["noise"] for one in nulls})
    return [
        share_score(
            "I",
            "an effect named though none is there",
            share(bool(one.said.effects) for one in nulls),
        ),
        *(
            share_score(
                "I",
                f"the same, noise of kind {kind}",
                share(
                    bool(one.said.effects) for one in nulls if one.answer["case"]["noise"] == kind
                ),
            )
            for kind in kinds
        ),
        share_score("I", "named first, of those findable", share(map(named_first, effects))),
        share_score(
            "I", "in the set, of those findable", share(one.covered(one.truth) for one in effects)
        ),
    ]


def other_base(outcomes: Sequence[Outcome]) -> list[Score]:
    """Tier J: a base model of the wrong form."""
    cases = main_of(outcomes, "J")
    effects = findable(cases)

    def false_names(one: Outcome) -> set[str]:
        return set(one.said.effects) - one.truths - BASE_TERMS[one.answer["case"]["wrong_base"]]

    return [
        share_score(
            "J",
            "named beside the base's own terms though not there",
            share(bool(false_names(one)) for one in cases),
        ),
        share_score(
            "J", "the base's own term named or in a set", share(_names_base(one) for one in cases)
        ),
        share_score(
            "J",
            "the effect in a set, of those findable",
            share(one.covered(one.truth) for one in effects),
        ),
    ]


def _names_base(one: Outcome) -> bool:
    return any(one.covered(name) for name in BASE_TERMS[one.answer["case"]["wrong_base"]])
