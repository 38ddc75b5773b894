"""The tables of a run, printed and kept: figures, effects, forms, designs, single cases."""

import json
from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict
from pathlib import Path

from benchmarks.renewed.scoring import (
    covered,
    detected,
    findable,
    right,
    right_or_unknown,
    score_all,
    silent,
    wrong,
)
from benchmarks.withheld.outcomes import Outcome
from benchmarks.withheld.scoring.figures import Score


def write_tables(outcomes: Sequence[Outcome], out: Path) -> str:
    """Write `tables.md` and `scores.json` into `out`; return the text of the first."""
    scores = score_all(outcomes, out)
    text = "\n\n".join(
        [
            figures(scores),
            by_form(findable(outcomes)),
            by_design([one for one in outcomes if one.tier == "N"]),
        ]
    )
    (out / "tables.md").write_text(text + "\n")
    kept = {
        "format": "tofcorr-renewed-scores",
        "scores": [asdict(one) for one in scores],
        "cases": [case(one, out) for one in outcomes],
    }
    (out / "scores.json").write_text(json.dumps(kept, indent=1))
    return text


def figures(scores: Sequence[Score]) -> str:
    """All figures as one table."""
    rows = [
        (
            one.tier,
            one.what,
            f"{one.value:.2f} [{one.interval[0]:.2f}, {one.interval[1]:.2f}]",
            one.count,
            one.target,
            {None: "", True: "met", False: "missed"}[one.met],
        )
        for one in scores
    ]
    return table(("recordings", "figure", "value", "n", "wanted", ""), rows)


def by_form(cases: Sequence[Outcome]) -> str:
    """What is said of every effect under each of its forms."""
    names = sorted({(one.truth, not _about(one)["textbook"], _about(one)["form"]) for one in cases})
    rows = []
    for effect, _, form in names:
        of_form = [one for one in cases if (one.truth, _about(one)["form"]) == (effect, form)]
        rows.append((effect, form, *_counts(of_form)))
    head = ("effect", "form", "n", "in the set", "set or unknown", "wrong single", "neither")
    return table(head, [*rows, ("all", "", *_counts(cases))])


def _counts(cases: Sequence[Outcome]) -> tuple[int, ...]:
    judges = (right, right_or_unknown, wrong, silent)
    return len(cases), *(sum(map(judge, cases)) for judge in judges)


DESIGNS: dict[str, Callable[[Outcome], str]] = {
    "frames": lambda one: _bin(_about(one)["design"]["frames"], (30, 60, 120)),
    "pixels": lambda one: _bin(_about(one)["sensor"]["width"], (48, 80, 160)),
    "robot, mm": lambda one: _bin(1e3 * _about(one)["design"]["robot"], (0.3, 0.6, 1.2)),
    "farthest, m": lambda one: _bin(_about(one)["design"]["far"], (1, 2, 4)),
    "mask": lambda one: _about(one)["design"]["mask"],
    "scene": lambda one: _about(one)["design"]["scene"],
    "spatial filter": lambda one: _about(one)["sensor"]["spatial_filter"],
    "temporal filter": lambda one: str(_about(one)["sensor"]["temporal_filter"]),
    "rounding, mm": lambda one: str(_about(one)["sensor"]["rounding_mm"]),
    "sun": lambda one: str(_about(one)["sensor"]["sun"]),
    "frequencies": lambda one: str(len(_about(one)["sensor"]["frequencies"])),
}


def by_design(nulls: Sequence[Outcome]) -> str:
    """What is said where nothing is missing, by what was drawn."""
    rows = []
    for what, of in DESIGNS.items():
        for value in sorted(set(map(of, nulls))):
            some = [one for one in nulls if of(one) == value]
            named = sum(bool(one.said.effects) for one in some)
            unknown = sum(one.said.unknown for one in some)
            rows.append((what, value, len(some), named, unknown, sum(map(detected, some))))
    return table(("nothing missing", "", "n", "named", "unknown", "detected"), rows)


def _bin(value: float, edges: Sequence[float]) -> str:
    low = [edge for edge in edges if edge <= value]
    high = [edge for edge in edges if edge > value]
    return f"{len(low)}: {low[-1] if low else 0} to {high[0] if high else 'more'}"


def _about(one: Outcome) -> dict:
    return one.answer["case"]


def case(one: Outcome, out: Path) -> dict:
    """What was true of one case and what was said."""
    return {
        "id": one.name,
        "case": _about(one),
        "role": one.role,
        "sizes_mm": one.answer["sizes_mm"],
        "findable": sorted(one.must_find),
        "oracle_mm": {"before": one.oracle.plain.before_mm, "after": one.oracle.plain.after_mm},
        "sets": [sorted(members) for members in one.said.sets],
        "effects": one.said.effects,
        "unknown": one.said.unknown,
        "detected": detected(one),
        "gap_mm": one.said.report.get("gap_mm"),
        "covered": covered(one, out),
        "failure": one.said.failure.strip().splitlines()[-1:],
        "seconds": one.said.seconds,
    }


def table(head: Sequence[str], rows: Iterable[Sequence[object]]) -> str:
    """A table in Markdown."""
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join("| " + " | ".join(str(cell) for cell in line) + " |" for line in lines)
