"""`python -m benchmarks.withheld`: the regression set, and pairs of a camera and a simulator."""

from collections.abc import Iterator, Sequence
from pathlib import Path

from benchmarks.renewed.real import write_real
from benchmarks.sealed.answers import Entry, Outcome
from benchmarks.sealed.command import Check
from benchmarks.sealed.scores import (
    NEW_NAME,
    Score,
    area_score,
    at_least,
    at_most,
    bootstrap,
    detected,
    macro_f1,
    mean_score,
    named,
    named_first,
    names_something_new,
    quantile_score,
    right,
    scores_table,
    set_sizes,
    share_score,
    shares_of,
    unknown,
    wrong,
)
from benchmarks.withheld.pairs import pairs
from benchmarks.withheld.tiers import TIERS, write_case

REAL_FORMS = ("odd_harmonics", "clear_layer", "soft_knee", "free_columns", "every_pixel")
REAL_MM = (3.0, 6.0)
BASE = {
    "distance": {"kind": "distance_polynomial", "degree": 3},
    "pixel": {"kind": "pixel_polynomial", "degree": 2},
    "amplitude": {"kind": "amplitude_polynomial", "variable": "amplitude", "degree": 2},
}
REMEDIES = {  # words of an advice that names what a confounded design lacks
    "exposure": ("integration", "exposure"),
    "tilt": ("tilt", "oblique", "incidence"),
    "target": ("reflectiv", "checkerboard", "grey", "dark", "target"),
}


def generate(seed: int, counts: dict[str, int], out: Path) -> Iterator[Entry]:
    """Write cases, real ones too where they are asked for."""
    for tier, count in counts.items():
        if tier == "K":
            yield from write_real(seed, out, REAL_FORMS, REAL_MM, BASE)
        for index in range(count if tier != "K" else 0):
            yield from write_case(seed, tier, index, out)


def score_all(outcomes: Sequence[Outcome], out: Path) -> tuple[list[Score], str]:
    """All figures of the tiers that are there, and them as text."""
    main = {
        tier: [one for one in outcomes if one.tier == tier and one.role == "main"] for tier in TIERS
    }
    find = {tier: [one for one in cases if one.must_find] for tier, cases in main.items()}
    scores = [
        *_single(find["A"], outcomes),
        *_several(main["B"]),
        *_nothing(main["C"]),
        *_not_in_catalogue("D", find, 0.95),
        *_not_in_catalogue("E", find, 0.85),
        *_confounded(main["F"], outcomes),
        *_missing(main["G"]),
        *_others(main, find),
        *_real([one for one in outcomes if one.tier == "K"]),
        share_score("all", "runs that failed", outcomes, lambda one: bool(one.said.failure)),
    ]
    return [one for one in scores if one.count], scores_table(scores)


def _single(cases: Sequence[Outcome], outcomes: Sequence[Outcome]) -> list[Score]:
    """Tier A: one effect that can be found."""
    said = [one for one in cases if named(one)]
    closed = [
        one.said.report["gap_mm"]["closed_fraction"] / one.oracle.closed_fraction for one in said
    ]
    fresh = {one.answer["main"]: one for one in outcomes if one.role == "fresh"}
    again = [(one, fresh[one.name]) for one in said if one.name in fresh]
    shrinkage = "shrinkage against the oracle, median"
    return [
        *shares_of("A", cases, {"named first": (named_first, at_least(0.85))}),
        *shares_of("A", cases, {"in the set": (right, at_least(0.95))}),
        mean_score("A", "size of the set", set_sizes(cases), at_most(1.5)),
        *shares_of("A", cases, {"something named": (named,)}),
        quantile_score("A", shrinkage, closed, 0.5, at_least(0.9)),
        quantile_score("A", "the same, 10th percentile", closed, 0.1, at_least(0.6)),
        *shares_of(
            "A", again, {"closed_ci holds what a fresh session shows": (_holds, at_least(0.9))}
        ),
    ]


def _holds(pair: tuple[Outcome, Outcome]) -> bool | None:
    """Whether the interval holds the closed share of another session with the same names."""
    one, again = (one.said for one in pair)
    if set(one.effects) != set(again.effects):
        return None
    low, high = one.report["gap_mm"]["closed_ci"]
    return low <= again.report["gap_mm"]["closed_fraction"] <= high


def _several(cases: Sequence[Outcome]) -> list[Score]:
    """Tier B: two or three effects."""
    wanted = [(one, name) for one in cases for name in sorted(one.must_find)]
    said = [(one, name) for one in cases for name in one.said.effects]
    limits = bootstrap(cases, macro_f1)
    return [
        Score("B", "macro-F1", macro_f1(cases), limits, len(cases), at_least(0.75)),
        *shares_of("B", wanted, {"in a set, of the effects findable": (lambda x: _covers(*x),)}),
        *shares_of("B", said, {"precision": (lambda pair: pair[1] in pair[0].truths,)}),
    ]


def _nothing(cases: Sequence[Outcome]) -> list[Score]:
    """Tier C: no effect, or one of 0.2 mm."""
    nulls = {
        "named though nothing is there": (named, at_most(0.08)),
        "called unknown": (unknown,),
        "detected": (detected,),
    }
    nearly = {"a false name beside 0.2 mm": (lambda one: bool({*one.said.effects} - one.truths),)}
    return [
        *shares_of("C", [one for one in cases if not one.truths], nulls),
        *shares_of("C", [one for one in cases if one.truths], nearly),
    ]


def _not_in_catalogue(tier: str, find: dict[str, list[Outcome]], target: float) -> list[Score]:
    """Tiers D and E: effects that the catalogue does not have."""
    positives, negatives = ([one.said.abstains for one in find[name]] for name in (tier, "A"))
    what = "AUROC of abstention against tier A"
    judges = {"called unknown": (unknown,), "a wrong single name": (wrong,)}
    area = area_score(tier, what, positives, negatives, at_least(target))
    return [area, *shares_of(tier, find[tier], judges)]


def _confounded(cases: Sequence[Outcome], outcomes: Sequence[Outcome]) -> list[Score]:
    """Tier F: designs that confound effects, each with a sound session."""
    cured = {one.answer["main"]: one for one in outcomes if one.role == "cured"}
    must = [one for one in cases if one.must_find]

    def resolved(one: Outcome) -> bool:
        return one.name in cured and cured[one.name].said.sets == (one.truths,)

    judges = {
        "sets that a sound session resolves": (resolved,),
        "advice that names the remedy": (_advises,),
    }
    open_ = [one for one in must if one.said.sets and len(one.said.sets[0]) > 1]
    return [
        *shares_of("F", must, {"truth in the set": (right, at_least(0.9))}),
        *shares_of("F", cases, {"a wrong single name": (wrong, at_most(0.05))}),
        *shares_of("F", open_, judges),
    ]


def _advises(one: Outcome) -> bool:
    advice = " ".join(map(str, one.said.report.get("next_recording") or [])).lower()
    return any(word in advice for lack in one.case["lacks"] for word in REMEDIES[lack])


def _missing(cases: Sequence[Outcome]) -> list[Score]:
    """Tier G: columns or files missing."""
    blind = {
        "says that the effect cannot be judged": (_says_unavailable,),
        "a wrong single name": (wrong,),
    }
    seen = [one for one in cases if one.case["judged"] and one.must_find]
    return [
        *shares_of("G", [one for one in cases if not one.case["judged"]], blind),
        *shares_of("G", seen, {"in the set where it can be judged still": (right,)}),
    ]


def _says_unavailable(one: Outcome) -> bool:
    ranking = one.said.report.get("ranking", [])
    return any(row["effect"] == one.truth and not row["available"] for row in ranking)


def _others(main: dict[str, list[Outcome]], find: dict[str, list[Outcome]]) -> list[Score]:
    """Tiers H, I and J: few frames, other noise, a base of another form."""
    few = {n: [one for one in find["H"] if one.case["design"]["frames"] == n] for n in (15, 30, 60)}
    nulls = [one for one in main["I"] if not one.truths]
    kinds = {one.case["noise"]: [] for one in sorted(nulls, key=lambda one: one.case["noise"])}
    for one in nulls:
        kinds[one.case["noise"]].append(one)
    found = [one for one in find["J"] if len(one.truths) > 1]
    own = {
        "named though not there": (_falsely_named,),
        "the base's own term in a set": (lambda one: _covers(one, one.case["base"]),),
    }
    beside = {
        "the effect in a set": (lambda one: _covers(one, *(one.truths - {one.case["base"]})),)
    }
    return [
        *(share_score("H", f"{n} frames: named", cases, named) for n, cases in few.items()),
        *(share_score("H", f"{n} frames: in the set", cases, right) for n, cases in few.items()),
        share_score("I", "named though nothing is there", nulls, named),
        *(share_score("I", f"the same, {kind}", cases, named) for kind, cases in kinds.items()),
        share_score("I", "in the set", [one for one in find["I"] if one.truths], right),
        *shares_of("J", main["J"], own),
        *shares_of("J", found, beside),
    ]


def _covers(one: Outcome, name: str) -> bool:
    return any(name in members for members in one.said.sets)


def _falsely_named(one: Outcome) -> bool:
    """Whether a name is neither true nor what a base of the wrong form is rightly called."""
    also = {"distance": "wiggling", "pixel": "fixed_pattern"}.get(one.case["base"], "")
    return bool(set(one.said.effects) - one.truths - {also})


def _real(cases: Sequence[Outcome]) -> list[Score]:
    """Tier K: what is named of what was done to real images."""
    done = {role: [one for one in cases if one.role == role] for role in ("term", "added")}
    judges = {"in a set": right, "named first": named_first}
    return [
        *(
            share_score("K", f"{role}: {what}", some, judge)
            for role, some in done.items()
            for what, judge in judges.items()
        ),
        *shares_of("K", done["added"], {NEW_NAME: (names_something_new(cases),)}),
    ]


main = Check(
    "Check `tofcorr diagnose` on recordings whose effect is withheld from it.",
    "tier",
    dict.fromkeys(TIERS, "") | {"K": "TOFCORR_REAL_DATA"},
    generate,
    score_all,
    cases=40,
).group
main.add_command(pairs, "pairs")

if __name__ == "__main__":
    main()
