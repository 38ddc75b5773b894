"""`python -m benchmarks.withheld`: the regression set, and pairs of a camera and a simulator."""

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
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
    table,
    unknown,
    wrong,
)
from benchmarks.withheld.pairs import pairs
from benchmarks.withheld.tiers import AUDIT, TIERS, write_case

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
    again = {one.answer["main"]: one for one in outcomes if one.role in ("fresh", "cured")}
    scores = [
        *_single(find["A"], again),
        *_several(main["B"]),
        *_nothing(main["C"]),
        *_not_in_catalogue(find),
        *_confounded(main["F"], find["F"], again),
        *_missing(main["G"]),
        *_few_and_noisy(find["H"], main["I"]),
        *_other_base(main["J"]),
        *_real([one for one in outcomes if one.tier == "K"]),
        share_score("all", "runs that failed", outcomes, lambda one: bool(one.said.failure)),
    ]
    audited = [one for one in outcomes if one.tier == "L"]
    text = "\n\n".join([scores_table(scores), *([audit_table(audited)] if audited else [])])
    return [one for one in scores if one.count], text


def _single(cases: Sequence[Outcome], fresh: Mapping[str, Outcome]) -> list[Score]:
    """Tier A: one effect that can be found."""
    said = [one for one in cases if named(one)]
    closed = [_closed(one) / one.oracle.closed_fraction for one in said]
    both = [(one, fresh[one.name]) for one in said if one.name in fresh]
    seen_again = "closed_ci holds what a fresh session shows"
    return [
        share_score("A", "named first", cases, named_first, at_least(0.85)),
        share_score("A", "in the set", cases, right, at_least(0.95)),
        mean_score("A", "size of the set", set_sizes(cases), at_most(1.5)),
        share_score("A", "something named", cases, named),
        quantile_score("A", "shrinkage against the oracle, median", closed, 0.5, at_least(0.9)),
        quantile_score("A", "the same, 10th percentile", closed, 0.1, at_least(0.6)),
        share_score("A", seen_again, both, lambda pair: _holds(*pair), at_least(0.9)),
    ]


def _closed(one: Outcome) -> float:
    return one.said.report["gap_mm"]["closed_fraction"]


def _holds(one: Outcome, again: Outcome) -> bool | None:
    """Whether the interval holds the closed share of another session with the same names."""
    if set(one.said.effects) != set(again.said.effects):
        return None
    low, high = one.said.report["gap_mm"]["closed_ci"]
    return low <= _closed(again) <= high


def _several(cases: Sequence[Outcome]) -> list[Score]:
    """Tier B: two or three effects."""
    wanted = [(one, name) for one in cases for name in sorted(one.must_find)]
    said = [name in one.truths for one in cases for name in one.said.effects]
    limits = bootstrap(cases, macro_f1)
    return [
        Score("B", "macro-F1", macro_f1(cases), limits, len(cases), at_least(0.75)),
        share_score("B", "in a set, of the effects findable", wanted, lambda pair: _covers(*pair)),
        share_score("B", "precision", said, bool),
    ]


def _nothing(cases: Sequence[Outcome]) -> list[Score]:
    """Tier C: no effect, or one of 0.2 mm."""
    nulls = [one for one in cases if not one.truths]
    nearly = [set(one.said.effects) - one.truths for one in cases if one.truths]
    return [
        share_score("C", "named though nothing is there", nulls, named, at_most(0.08)),
        share_score("C", "called unknown", nulls, unknown),
        share_score("C", "detected", nulls, detected),
        share_score("C", "a false name beside 0.2 mm", nearly, bool),
    ]


def _not_in_catalogue(find: Mapping[str, Sequence[Outcome]]) -> list[Score]:
    """Tiers D and E: effects that the catalogue does not have."""
    scores = []
    for tier, target in (("D", 0.95), ("E", 0.85)):
        positives, negatives = ([one.said.abstains for one in find[name]] for name in (tier, "A"))
        what = "AUROC of abstention against tier A"
        scores += [
            area_score(tier, what, positives, negatives, at_least(target)),
            share_score(tier, "called unknown", find[tier], unknown),
            share_score(tier, "a wrong single name", find[tier], wrong),
        ]
    return scores


def _confounded(
    cases: Sequence[Outcome], must: Sequence[Outcome], cured: Mapping[str, Outcome]
) -> list[Score]:
    """Tier F: designs that confound effects, each with a sound session."""
    open_ = [one for one in must if one.said.sets and len(one.said.sets[0]) > 1]
    resolved = [one.name in cured and cured[one.name].said.sets == (one.truths,) for one in open_]
    return [
        share_score("F", "truth in the set", must, right, at_least(0.9)),
        share_score("F", "a wrong single name", cases, wrong, at_most(0.05)),
        share_score("F", "sets that a sound session resolves", resolved, bool),
        share_score("F", "advice that names the remedy", open_, _advises),
    ]


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


def _few_and_noisy(few: Sequence[Outcome], noisy: Sequence[Outcome]) -> list[Score]:
    """Tiers H and I: few frames, other noise."""
    scores = []
    for what, judge in (("named", named), ("in the set", right)):
        for n in (15, 30, 60):
            some = [one for one in few if one.case["design"]["frames"] == n]
            scores.append(share_score("H", f"{n} frames: {what}", some, judge))
    nulls = [one for one in noisy if not one.truths]
    found = [one for one in noisy if one.truths and one.must_find]
    scores.append(share_score("I", "named though nothing is there", nulls, named))
    for kind in sorted({one.case["noise"] for one in nulls}):
        some = [one for one in nulls if one.case["noise"] == kind]
        scores.append(share_score("I", f"the same, {kind}", some, named))
    return [*scores, share_score("I", "in the set", found, right)]


def _other_base(cases: Sequence[Outcome]) -> list[Score]:
    """Tier J: a base of another form, alone or beside an effect."""
    own = [_covers(one, one.case["base"]) for one in cases]
    beside = [one for one in cases if one.must_find and len(one.truths) > 1]
    found = [_covers(one, *(one.truths - {one.case["base"]})) for one in beside]
    return [
        share_score("J", "named though not there", cases, _falsely_named),
        share_score("J", "the base's own term in a set", own, bool),
        share_score("J", "the effect in a set", found, bool),
    ]


def _covers(one: Outcome, name: str) -> bool:
    return any(name in members for members in one.said.sets)


def _falsely_named(one: Outcome) -> bool:
    """Whether a name is neither true nor what a base of the wrong form is rightly called."""
    also = {"distance": "wiggling", "pixel": "fixed_pattern"}.get(one.case["base"], "")
    return bool(set(one.said.effects) - one.truths - {also})


def _real(cases: Sequence[Outcome]) -> list[Score]:
    """Tier K: what is named of what was done to real images."""
    scores = []
    for role in ("term", "added"):
        some = [one for one in cases if one.role == role]
        scores.append(share_score("K", f"{role}: in a set", some, right))
        scores.append(share_score("K", f"{role}: named first", some, named_first))
    return [*scores, share_score("K", NEW_NAME, some, names_something_new(cases))]


RIGHT, SET, WARNING, WRONG = ANSWERS = ("right", "set holds it", "warning says why", "WRONG")


def judged(one: Outcome) -> str:
    """The judgement of a case of tier L.

    A set without a true effect is wrong, whatever else is said; so is silence about an effect, and
    a missing warning where one is needed. "Unknown" is a warning where an effect is missing, and so
    is a refusal.
    """
    if "CalibrationDataError" in one.said.failure:
        return WARNING
    sets, needed, left = one.said.sets, one.case["says"], one.truths - set().union(*one.said.sets)
    warned = not needed or any(needed in text for text in one.said.report.get("warnings", []))
    if one.said.failure or not warned or any(not members & one.truths for members in sets):
        return WRONG
    if not one.truths:
        return WRONG if sets or unknown(one) else WARNING if needed else RIGHT
    if not left:
        return RIGHT if all(len(members) == 1 for members in sets) else SET
    return WARNING if unknown(one) else WRONG


def audit_table(cases: Sequence[Outcome]) -> str:
    """How often each case of an audit is answered how."""
    rows = []
    for row in AUDIT:
        found = Counter(judged(one) for one in cases if one.case["row"] == row)
        rows.append((row, found.total(), *(found[answer] or "" for answer in ANSWERS)))
    return table(("case", "n", *ANSWERS), rows)


main = Check(
    "Check `tofcorr diagnose` on recordings whose effect is withheld from it.",
    "tier",
    dict.fromkeys(TIERS, "") | {"K": "TOFCORR_REAL_DATA", "L": "DRJIT_LIBLLVM_PATH"},
    generate,
    score_all,
    cases=40,
).group
main.add_command(pairs, "pairs")

if __name__ == "__main__":
    main()
