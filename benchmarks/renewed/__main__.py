"""`python -m benchmarks.renewed`: the check on forms, sensors and robots that nobody tuned on."""

from collections.abc import Callable, Iterable, Sequence
from pathlib import Path

from benchmarks.renewed.cases import TIERS, write_case
from benchmarks.renewed.real import write_real
from benchmarks.sealed.answers import Entry, Outcome
from benchmarks.sealed.command import Check
from benchmarks.sealed.remains import covered
from benchmarks.sealed.scores import (
    LEAST_MM,
    NEW_NAME,
    Score,
    at_least,
    at_most,
    by_design,
    covers,
    detected,
    figures,
    named,
    names_something_new,
    scores_table,
    share_score,
    silent,
    table,
    unknown,
    wrong,
)

MANY = 25  # poses: recordings with as many are also counted by themselves
LEVEL = (0.03, 0.07)  # share of recordings with nothing missing that are named, or called unknown
COVERAGE = (0.92, 0.98)  # of 95 % intervals
TARGETS = {
    "in the set": at_least(0.9),
    "size of the set": at_most(1.8),
    "a single wrong name": at_most(0.05),
}


def generate(seed: int, tier: str, index: int, out: Path) -> Iterable[Entry]:
    """Write a case; all real ones, of which there is one set, come with the first."""
    if tier == "K":
        return () if index else write_real(seed, out)
    return (write_case(seed, tier, index, out),)


def findable(outcomes: Sequence[Outcome]) -> list[Outcome]:
    """Cases of one effect of 2 mm or more that an oracle with the true form finds."""
    cases = [one for one in outcomes if one.tier == "E" and one.must_find]
    return [one for one in cases if one.answer["sizes_mm"][one.truth] >= LEAST_MM]


def score_all(outcomes: Sequence[Outcome], out: Path) -> tuple[list[Score], str]:
    """All figures, and them as text with tables of forms and designs."""
    cases, nulls = findable(outcomes), [one for one in outcomes if one.tier == "N"]
    outside = [one for one in outcomes if one.tier == "O"]
    real = {role: [x for x in outcomes if x.role == role] for role in ("added", "term")}
    other = {"in the set or unknown": at_least(0.9), "a single wrong name": at_most(0.08)}
    level = {
        "named though nothing is there": LEVEL,
        "called unknown though nothing is there": LEVEL,
        "detected though nothing is there": at_most(0.1),
    }
    scores = [
        *figures("findable", cases, TARGETS),
        *figures("textbook form", [one for one in cases if one.case["textbook"]], TARGETS),
        *figures("other form", [one for one in cases if not one.case["textbook"]], other),
        *figures("25 poses or more", _many(cases), TARGETS),
        *figures("outside", outside, {"a single wrong name": at_most(0.08)}),
        *figures("nothing", nulls, level),
        *figures("nothing, 25 poses", _many(nulls), level),
        *_coverage("all", [one for one in outcomes if one.tier in TIERS], out),
        *_coverage("one effect", cases, out),
        *_coverage("nothing", nulls, out),
        *figures("real, effect added", real["added"]),
        share_score("real", NEW_NAME, map(names_something_new(outcomes), real["added"])),
        *figures("real, term withheld", real["term"]),
        share_score("all", "runs that failed", (bool(one.said.failure) for one in outcomes)),
    ]
    judged = [(one.case, (named(one), unknown(one), detected(one))) for one in nulls]
    head = ("nothing missing", "", "n", "named", "unknown", "detected")
    text = "\n\n".join([scores_table(scores), by_form(cases), table(head, by_design(judged))])
    return [one for one in scores if one.count], text


def _many(cases: Sequence[Outcome]) -> list[Outcome]:
    return [one for one in cases if one.case["design"]["poses"] >= MANY]


def _coverage(title: str, cases: Sequence[Outcome], out: Path) -> list[Score]:
    held = [covered(one, out) for one in cases]
    return [
        share_score(title, f"{gap}_ci holds the truth", (one.get(gap) for one in held), COVERAGE)
        for gap in ("before", "after", "closed")
    ]


def by_form(cases: Sequence[Outcome]) -> str:
    """What is said of every effect under each of its forms."""
    judges: dict[str, Callable[[Outcome], bool]] = {
        "in the set": lambda one: covers(one, one.truth),
        "set or unknown": lambda one: covers(one, one.truth) or unknown(one),
        "wrong single": wrong,
        "neither": silent,
    }
    groups: dict[tuple[str, bool, str], list[Outcome]] = {}
    for one in cases:
        key = one.truth, not one.case["textbook"], one.case["form"]
        groups.setdefault(key, []).append(one)
    rows = [(effect, form, some) for (effect, _, form), some in sorted(groups.items())]
    lines = [
        (effect, form, len(some), *(sum(map(judge, some)) for judge in judges.values()))
        for effect, form, some in [*rows, ("all", "", list(cases))]
    ]
    return table(("effect", "form", "n", *judges), lines)


main = Check(
    "Check `tofcorr diagnose` on recordings that nobody tuned it on.",
    "tier",
    dict.fromkeys(TIERS, "") | {"K": "TOFCORR_REAL_DATA"},
    generate,
    score_all,
    cases=59,
    config="simulate_anew: false\npage: false\n",
    with_remains=True,
).group

if __name__ == "__main__":
    main()
