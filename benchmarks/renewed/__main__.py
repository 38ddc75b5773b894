"""`python -m benchmarks.renewed`: the check on forms, sensors and robots that nobody tuned on."""

from collections.abc import Iterator, Sequence
from pathlib import Path

from benchmarks.renewed.cases import TIERS, write_case
from benchmarks.renewed.real import FORMS, write_real
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
    detected,
    mean_score,
    named,
    names_something_new,
    right,
    right_or_unknown,
    scores_table,
    set_sizes,
    share_score,
    shares_of,
    silent,
    table,
    unknown,
    wrong,
)

MANY = 25  # poses: recordings with as many are also counted by themselves
LEVEL = (0.03, 0.07)  # share of recordings with nothing missing that are named, or called unknown
COVERAGE = (0.92, 0.98)  # of 95 % intervals


def generate(seed: int, counts: dict[str, int], out: Path) -> Iterator[Entry]:
    """Write cases, real ones too where they are asked for."""
    for tier, count in counts.items():
        if tier == "K":
            yield from write_real(seed, out, FORMS)
        else:
            yield from (write_case(seed, tier, index, out) for index in range(count))


def findable(outcomes: Sequence[Outcome]) -> list[Outcome]:
    """Cases of one effect of 2 mm or more that an oracle with the true form finds."""
    cases = [one for one in outcomes if one.tier == "E" and one.must_find]
    return [one for one in cases if one.answer["sizes_mm"][one.truth] >= LEAST_MM]


def score_all(outcomes: Sequence[Outcome], out: Path) -> tuple[list[Score], str]:
    """All figures, and them as text with tables of forms and designs."""
    cases, nulls = findable(outcomes), [one for one in outcomes if one.tier == "N"]
    parts = {flag: [one for one in cases if one.case["textbook"] is flag] for flag in (True, False)}
    outside = [one for one in outcomes if one.tier == "O" and one.must_find]
    many, wide = [one for one in cases if _poses(one) >= MANY], (right_or_unknown, at_least(0.9))
    scores = [
        *_one_effect("findable", cases),
        *_one_effect("textbook form", parts[True]),
        *shares_of("other form", parts[False], {"in the set or unknown": wide}),
        *_said("other form", parts[False], 0.08),
        *_one_effect("25 poses or more", many),
        *_said("outside", outside, 0.08),
        *_nothing("nothing", nulls),
        *_nothing("nothing, 25 poses", [one for one in nulls if _poses(one) >= MANY]),
        *_coverage("all", [one for one in outcomes if one.tier in TIERS], out),
        *_coverage("one effect", cases, out),
        *_coverage("nothing", nulls, out),
        *_real([one for one in outcomes if one.tier == "K"]),
        share_score("all", "runs that failed", outcomes, lambda one: bool(one.said.failure)),
    ]
    judged = [(one.case, (named(one), unknown(one), detected(one))) for one in nulls]
    head = ("nothing missing", "", "n", "named", "unknown", "detected")
    text = "\n\n".join([scores_table(scores), by_form(cases), table(head, by_design(judged))])
    return [one for one in scores if one.count], text


def _one_effect(title: str, cases: Sequence[Outcome]) -> list[Score]:
    return [
        *shares_of(title, cases, {"in the set": (right, at_least(0.9))}),
        mean_score(title, "size of the set", set_sizes(cases), at_most(1.8)),
        *_said(title, cases, 0.05),
    ]


def _said(title: str, cases: Sequence[Outcome], most_wrong: float) -> list[Score]:
    judges = {
        "a single wrong name": (wrong, at_most(most_wrong)),
        "something named": (named,),
        "called unknown": (unknown,),
        "neither": (silent,),
    }
    return shares_of(title, cases, judges)


def _nothing(title: str, cases: Sequence[Outcome]) -> list[Score]:
    judges = {
        "named": (named, LEVEL),
        "unknown": (unknown, LEVEL),
        "detected": (detected, at_most(0.1)),
    }
    return shares_of(title, cases, judges)


def _coverage(title: str, cases: Sequence[Outcome], out: Path) -> list[Score]:
    held = [covered(one, out) for one in cases]
    judges = {
        f"{name}_ci holds the truth": (lambda held, name=name: held.get(name), COVERAGE)
        for name in ("before", "after", "closed")
    }
    return shares_of(title, held, judges)


def _real(cases: Sequence[Outcome]) -> list[Score]:
    """Real recordings: what is named of what was added, beside what they show as they are."""
    judges = {
        "added effect in the set": (right,),
        "added effect in the set or unknown": (right_or_unknown,),
        NEW_NAME: (names_something_new(cases),),
    }
    return shares_of("real", [one for one in cases if one.role == "added"], judges)


def by_form(cases: Sequence[Outcome]) -> str:
    """What is said of every effect under each of its forms."""
    judges = {"in the set": right, "set or unknown": right_or_unknown, "wrong single": wrong}
    judges["neither"] = silent
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


def _poses(one: Outcome) -> int:
    return one.case["design"]["poses"]


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
