"""The program beside the baselines, on the recordings that all of them saw."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from benchmarks.withheld.outcomes import (
    Outcome,
    Said,
    exact,
    findable,
    main_of,
    named_first,
    read_baselines,
)
from benchmarks.withheld.statistics import Share, share

PROGRAM = "tofcorr diagnose"


@dataclass(frozen=True)
class Row:
    """One method's figures; a covariate that speaks for several effects is right if one is true."""

    method: str
    named_first: Share  # tier A, of those findable
    exact_single: Share  # tier A
    exact_several: Share  # tier B
    false_alarms: Share  # tier C, nothing there


def compare(outcomes: Sequence[Outcome], out: Path) -> list[Row]:
    """One row for the program and one for each baseline."""
    answers = {one.name: read_baselines(out, one.name) for one in outcomes if one.role == "main"}
    seen = [one for one in outcomes if answers.get(one.name) and one.tier in {"A", "B", "C"}]
    if not seen:
        return []
    methods = list(answers[seen[0].name])
    swapped = {name: [_as_said(one, answers[one.name][name]) for one in seen] for name in methods}
    return [_row(PROGRAM, seen), *(_row(name, cases) for name, cases in swapped.items())]


def ahead(rows: Sequence[Row]) -> bool:
    """Whether the program leads every baseline in exact sets and in false alarms."""
    program, others = rows[0], rows[1:]
    return all(_ahead(program, other) for other in others)


def _ahead(program: Row, other: Row) -> bool:
    more_exact = _joined(program).value > _joined(other).value
    return more_exact and program.false_alarms.value <= max(other.false_alarms.value, 0.05)


def _joined(row: Row) -> Share:
    a, b = row.exact_single, row.exact_several
    return Share(a.hits + b.hits, a.total + b.total)


def _row(method: str, cases: Sequence[Outcome]) -> Row:
    single, several = findable(main_of(cases, "A")), main_of(cases, "B")
    nulls = [one for one in main_of(cases, "C") if not one.truths]
    return Row(
        method,
        named_first=share(map(named_first, single)),
        exact_single=share(map(exact, single)),
        exact_several=share(map(exact, several)),
        false_alarms=share(bool(one.said.effects) for one in nulls),
    )


def _as_said(one: Outcome, said: Said) -> Outcome:
    """The outcome with a baseline's answer, a covariate credited with what it speaks for."""
    pairs = zip(said.effects, said.sets, strict=True)
    credited = tuple(next(iter(sorted(members & one.truths)), effect) for effect, members in pairs)
    return replace(one, said=replace(said, effects=credited))
