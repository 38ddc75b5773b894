"""`python -m benchmarks.withheld`: the regression set, and pairs of a camera and a simulator."""

from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path

from benchmarks.sealed.answers import Outcome
from benchmarks.sealed.command import Check
from benchmarks.sealed.scores import (
    Limits,
    Score,
    area_score,
    at_least,
    at_most,
    bootstrap,
    figures,
    macro_f1,
    named,
    quantile_score,
    scores_table,
    share_score,
    table,
    unknown,
)
from benchmarks.withheld.pairs import pairs
from benchmarks.withheld.tiers import AUDIT, TIERS, write_case

REMEDIES = {  # words of an advice that names what a confounded design lacks
    "exposure": ("integration", "exposure"),
    "tilt": ("tilt", "oblique", "incidence"),
    "target": ("reflectiv", "checkerboard", "grey", "dark", "target"),
}


TARGETS: dict[str, dict[str, Limits]] = {
    "A": {
        "named first": at_least(0.85),
        "in the set": at_least(0.95),
        "size of the set": at_most(1.5),
    },
    "C": {"named though nothing is there": at_most(0.08)},
    "F": {"in the set": at_least(0.9), "a single wrong name": at_most(0.05)},
}


def score_all(outcomes: Sequence[Outcome], out: Path) -> tuple[list[Score], str]:
    """All figures of the tiers that are there, and them as text."""
    main = {k: [one for one in outcomes if one.tier == k and one.role == "main"] for k in TIERS}
    again = {one.answer["main"]: one for one in outcomes if one.role in ("fresh", "cured")}
    scores: list[Score] = []
    for tier, cases in main.items():
        scores += figures(tier, cases, TARGETS.get(tier))
    scores += _closed(main["A"], again)
    limits = bootstrap(main["B"], macro_f1)
    scores += [Score("B", "macro-F1", macro_f1(main["B"]), limits, len(main["B"]), at_least(0.75))]
    abstains = {k: [one.said.abstains for one in main[k] if one.must_find] for k in "ADE"}
    for tier, target in (("D", at_least(0.95)), ("E", at_least(0.85))):
        what = "AUROC of abstention against tier A"
        scores.append(area_score(tier, what, abstains[tier], abstains["A"], target))
    scores += _confounded(main["F"], again)
    blind = [one for one in main["G"] if not one.case["judged"]]
    unavailable = map(_says_unavailable, blind)
    scores.append(share_score("G", "says that the effect cannot be judged", unavailable))
    for what, tier, of in (
        ("frames", "H", lambda one: one.case["design"]["frames"]),
        ("noise", "I", lambda one: one.case["noise"]),
        ("base", "J", lambda one: one.case["base"]),
    ):
        for value in sorted({of(one) for one in main[tier]}):
            some = [one for one in main[tier] if of(one) == value]
            scores += figures(f"{tier}, {what} {value}", some)
    failed = [bool(one.said.failure) for one in outcomes]
    scores.append(share_score("all", "runs that failed", failed))
    text = [scores_table(scores), *([audit_table(main["L"])] if main["L"] else [])]
    return [one for one in scores if one.count], "\n\n".join(text)


def _closed(cases: Sequence[Outcome], fresh: Mapping[str, Outcome]) -> list[Score]:
    """Of tier A: what share of the gap is said to be closed."""
    said = [one for one in cases if one.must_find and named(one)]
    closed = [_share(one) / one.oracle.closed_fraction for one in said]
    held = [_holds(one, fresh[one.name]) for one in said if one.name in fresh]
    seen_again = "closed_ci holds what a fresh session shows"
    return [
        quantile_score("A", "shrinkage against the oracle, median", closed, 0.5, at_least(0.9)),
        quantile_score("A", "the same, 10th percentile", closed, 0.1, at_least(0.6)),
        share_score("A", seen_again, held, at_least(0.9)),
    ]


def _share(one: Outcome) -> float:
    return one.said.report["gap_mm"]["closed_fraction"]


def _holds(one: Outcome, again: Outcome) -> bool | None:
    """Whether the interval holds the closed share of another session with the same names."""
    if set(one.said.effects) != set(again.said.effects):
        return None
    low, high = one.said.report["gap_mm"]["closed_ci"]
    return low <= _share(again) <= high


def _confounded(cases: Sequence[Outcome], cured: Mapping[str, Outcome]) -> list[Score]:
    """Of tier F: designs that confound effects, each with a sound session."""
    open_ = [one for one in cases if one.must_find and [*map(len, one.said.sets)][:1] > [1]]
    resolved = [one.name in cured and cured[one.name].said.sets == (one.truths,) for one in open_]
    return [
        share_score("F", "sets that a sound session resolves", resolved),
        share_score("F", "advice that names the remedy", map(_advises, open_)),
    ]


def _advises(one: Outcome) -> bool:
    advice = " ".join(map(str, one.said.report.get("next_recording") or [])).lower()
    return any(word in advice for lack in one.case["lacks"] for word in REMEDIES[lack])


def _says_unavailable(one: Outcome) -> bool:
    ranking = one.said.report.get("ranking", [])
    return any(row["effect"] == one.truth and not row["available"] for row in ranking)


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
    dict.fromkeys(TIERS, "") | {"L": "DRJIT_LIBLLVM_PATH"},
    write_case,
    score_all,
    cases=40,
).group
main.add_command(pairs, "pairs")

if __name__ == "__main__":
    main()
