"""`python -m benchmarks.withheld`: the regression set, and pairs of a camera and a simulator."""

from collections.abc import Iterator, Sequence
from pathlib import Path

from benchmarks.renewed.real import write_real
from benchmarks.sealed.answers import Entry, Outcome
from benchmarks.sealed.command import Check
from benchmarks.sealed.scores import (
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
    quantile_score,
    right,
    scores_table,
    set_sizes,
    share_score,
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
    closed = [
        one.said.report["gap_mm"]["closed_fraction"] / one.oracle.closed_fraction
        for one in cases
        if named(one)
    ]
    fresh = {one.answer["main"]: one for one in outcomes if one.role == "fresh"}
    again = [(one, fresh[one.name]) for one in cases if one.name in fresh and named(one)]
    return [
        share_score("A", "named first", cases, named_first, at_least(0.85)),
        share_score("A", "in the set", cases, right, at_least(0.95)),
        mean_score("A", "size of the set", set_sizes(cases), at_most(1.5)),
        share_score("A", "something named", cases, named),
        quantile_score("A", "shrinkage against the oracle, median", closed, 0.5, at_least(0.9)),
        quantile_score("A", "the same, 10th percentile", closed, 0.1, at_least(0.6)),
        share_score(
            "A", "closed_ci holds what a fresh session shows", again, _holds, at_least(0.9)
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
        share_score(
            "B",
            "in a set, of the effects findable",
            wanted,
            lambda pair: any(pair[1] in members for members in pair[0].said.sets),
        ),
        share_score("B", "precision", said, lambda pair: pair[1] in pair[0].truths),
    ]


def _nothing(cases: Sequence[Outcome]) -> list[Score]:
    """Tier C: no effect, or one of 0.2 mm."""
    nulls = [one for one in cases if not one.truths]
    nearly = [one for one in cases if one.truths]
    return [
        share_score("C", "named though nothing is there", nulls, named, at_most(0.08)),
        share_score("C", "called unknown", nulls, unknown),
        share_score("C", "detected", nulls, detected),
        share_score(
            "C",
            "a false name beside 0.2 mm",
            nearly,
            lambda one: bool({*one.said.effects} - one.truths),
        ),
    ]


def _not_in_catalogue(tier: str, find: dict[str, list[Outcome]], target: float) -> list[Score]:
    """Tiers D and E: effects that the catalogue does not have."""
    positives, negatives = ([one.said.abstains for one in find[name]] for name in (tier, "A"))
    what = "AUROC of abstention against tier A"
    return [
        area_score(tier, what, positives, negatives, at_least(target)),
        share_score(tier, "called unknown", find[tier], unknown),
        share_score(tier, "a wrong single name", find[tier], wrong),
    ]


def _confounded(cases: Sequence[Outcome], outcomes: Sequence[Outcome]) -> list[Score]:
    """Tier F: designs that confound effects, each with a sound session."""
    cured = {one.answer["main"]: one for one in outcomes if one.role == "cured"}
    must = [one for one in cases if one.must_find]
    open_ = [one for one in must if one.said.sets and len(one.said.sets[0]) > 1]
    return [
        share_score("F", "truth in the set", must, right, at_least(0.9)),
        share_score("F", "a wrong single name", cases, wrong, at_most(0.05)),
        share_score(
            "F", "sets that a sound session resolves", open_,
            lambda one: one.name in cured and cured[one.name].said.sets == (one.truths,),
        ),
        share_score("F", "advice that names the remedy", open_, _advises),
    ]  # fmt: skip


def _advises(one: Outcome) -> bool:
    advice = " ".join(map(str, one.said.report.get("next_recording") or [])).lower()
    return any(word in advice for lack in one.case["lacks"] for word in REMEDIES[lack])


def _missing(cases: Sequence[Outcome]) -> list[Score]:
    """Tier G: columns or files missing."""
    blind = [one for one in cases if not one.case["judged"]]
    seen = [one for one in cases if one.case["judged"] and one.must_find]
    return [
        share_score("G", "says that the effect cannot be judged", blind, _says_unavailable),
        share_score("G", "a wrong single name", blind, wrong),
        share_score("G", "in the set where it can be judged still", seen, right),
    ]


def _says_unavailable(one: Outcome) -> bool:
    ranking = one.said.report.get("ranking", [])
    return any(row["effect"] == one.truth and not row["available"] for row in ranking)


def _others(main: dict[str, list[Outcome]], find: dict[str, list[Outcome]]) -> list[Score]:
    """Tiers H, I and J: few frames, other noise, a base of another form."""
    few = {n: [one for one in find["H"] if one.case["design"]["frames"] == n] for n in (15, 30, 60)}
    nulls = [one for one in main["I"] if not one.truths]
    kinds = {kind: [one for one in nulls if one.case["noise"] == kind] for kind in _kinds(nulls)}
    found = [one for one in find["J"] if len(one.truths) > 1]
    return [
        *(share_score("H", f"{n} frames: named", cases, named) for n, cases in few.items()),
        *(share_score("H", f"{n} frames: in the set", cases, right) for n, cases in few.items()),
        share_score("I", "named though nothing is there", nulls, named),
        *(share_score("I", f"the same, {kind}", cases, named) for kind, cases in kinds.items()),
        share_score("I", "in the set", [one for one in find["I"] if one.truths], right),
        share_score("J", "named though not there", main["J"], lambda one: bool(_false(one))),
        share_score("J", "the effect in a set", found, lambda one: _covers(one, _beside(one))),
        share_score(
            "J",
            "the base's own term in a set",
            main["J"],
            lambda one: _covers(one, one.case["base"]),
        ),
    ]


def _kinds(cases: Sequence[Outcome]) -> list[str]:
    return sorted({one.case["noise"] for one in cases})


def _beside(one: Outcome) -> str:
    (name,) = one.truths - {one.case["base"]}
    return name


def _covers(one: Outcome, name: str) -> bool:
    return any(name in members for members in one.said.sets)


def _false(one: Outcome) -> set[str]:
    """Names that are neither true nor what a base of the wrong form is rightly called."""
    also = {"distance": "wiggling", "pixel": "fixed_pattern"}.get(one.case["base"], "")
    return set(one.said.effects) - one.truths - {also}


def _real(cases: Sequence[Outcome]) -> list[Score]:
    """Tier K: what is named of what was done to real images."""
    own = {name for one in cases if one.role == "plain" for name in one.said.effects}
    done = {role: [one for one in cases if one.role == role] for role in ("term", "added")}
    return [
        *(
            share_score("K", f"{role}: {what}", done[role], judge)
            for role in done
            for what, judge in (("in a set", right), ("named first", named_first))
        ),
        share_score(
            "K", "named though neither added nor seen before", done["added"],
            lambda one: bool(set(one.said.effects) - one.truths - own),
        ),
    ]  # fmt: skip


main = Check(
    "Check `tofcorr diagnose` on recordings whose effect is withheld from it.",
    "tiers",
    dict.fromkeys(TIERS, "") | {"K": "TOFCORR_REAL_DATA"},
    generate,
    score_all,
    cases=40,
).group()
main.add_command(pairs, "pairs")

if __name__ == "__main__":
    main()
