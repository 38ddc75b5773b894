"""The tables of a run: levels with nothing missing, by what was drawn; coverage by kind of case."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from benchmarks.levels.cases import KINDS
from benchmarks.levels.pairs import pairs_table
from benchmarks.renewed.scoring import PART_OF
from benchmarks.renewed.tables import table
from benchmarks.withheld.statistics import Share, share

Row = Mapping[str, Any]
SINGLE = ("effect", "outside")
GAPS = ("before", "after", "closed")
SAID: dict[str, Callable[[Row], bool]] = {
    "named": lambda row: bool(row["names"]),
    "unknown": lambda row: row["unknown"],
    "detected": lambda row: row["tested"] and (bool(row["names"]) or row["unknown"]),
}
STRATA: dict[str, Callable[[Row], str]] = {
    "poses": lambda row: _bin(row["poses"], (8, 16, 32, 48)),
    "image": lambda row: f"{row['sensor']['width']}×{row['sensor']['height']}",
    "robot, mm": lambda row: _bin(1e3 * row["design"]["robot"], (0.3, 0.6, 1.2)),
    "spatial filter": lambda row: row["sensor"]["spatial_filter"],
    "temporal filter": lambda row: str(row["sensor"]["temporal_filter"]),
    "rounding, mm": lambda row: f"{row['sensor']['rounding_mm']:g}",
    "sun": lambda row: "yes" if row["sensor"]["sun"] else "no",
    "frequencies": lambda row: str(len(row["sensor"]["frequencies"])),
    "mask": lambda row: row["design"]["mask"],
    "repeats": lambda row: "yes" if row["design"]["repeated"] else "no",
}
QUANTILES = (0.01, 0.02, 0.05, 0.1, 0.25, 0.5, 0.75)


def tables(rows: Sequence[Row]) -> str:
    """Return all tables as Markdown."""
    nothing = [row for row in rows if row["kind"] == "nothing"]
    effects = [row for row in rows if row["kind"] in SINGLE and row["must_find"]]
    pairs = [row for row in rows if row["kind"] == "pair"]
    found = [_levels(nothing), _quantiles(nothing), _found(effects), pairs_table(pairs)]
    parts = [*found, _coverage(rows)]
    return "\n\n".join(part for part in parts if part)


def _levels(rows: Sequence[Row]) -> str:
    if not rows:
        return ""
    head = ("nothing missing", "", "n", *SAID)
    lines: list[tuple[object, ...]] = []
    for what, some in (("all", rows), ("tested", [row for row in rows if row["tested"]])):
        counted = (_text(share(map(of, some))) for of in SAID.values())
        lines.append((what, "", len(some), *counted))
    for what, of in STRATA.items():
        for value in sorted(set(map(of, rows))):
            some = [row for row in rows if of(row) == value]
            lines.append((what, value, len(some), *(sum(map(s, some)) for s in SAID.values())))
    return table(head, lines)


def _quantiles(rows: Sequence[Row]) -> str:
    """Of the p-values with nothing missing: uniform ones equal the head of the table."""
    rows = [row for row in rows if row["tested"] and not row["names"]]
    if not rows:
        return ""
    found = {"joined": np.array([row["p_value"] for row in rows])}
    found |= {
        name: np.array([row["p_values"][name] for row in rows]) for name in rows[0]["p_values"]
    }
    head = ("share of p-values at most", *(f"{q:g}" for q in QUANTILES))
    return table(
        head, [(k, *(f"{np.mean(v <= q + 1e-9):.3f}" for q in QUANTILES)) for k, v in found.items()]
    )


def _found(rows: Sequence[Row]) -> str:
    if not rows:
        return ""
    head = ("findable effects", "n", "in a set", "in a set or unknown", "unknown", "detected")
    lines = []
    for kind in SINGLE:
        some = [row for row in rows if row["kind"] == kind]
        if some:
            names = [{name for one in row["sets"] for name in one} for row in some]
            sets = [
                row["effect"] in own | {PART_OF.get(name) for name in own}
                for row, own in zip(some, names, strict=True)
            ]
            unknown = [row["unknown"] for row in some]
            either = [a or b for a, b in zip(sets, unknown, strict=True)]
            found = (sets, either, unknown, map(SAID["detected"], some))
            lines.append((kind, len(some), *(_text(share(each)) for each in found)))
    return table(head, lines)


def _coverage(rows: Sequence[Row]) -> str:
    head = ("95 % intervals hold the truth", "n", *GAPS, "before, all pixels alike")
    groups = {"all": rows} | {k: [row for row in rows if row["kind"] == k] for k in KINDS}
    groups |= {
        f"{name} poses": [row for row in rows if _bin(row["poses"], (16, 32)) == name]
        for name in sorted({_bin(row["poses"], (16, 32)) for row in rows})
    }
    lines = []
    for name, some in groups.items():
        if some:
            alike = [
                row["intervals"]["before"][0]
                <= row["before_all_alike_mm"]
                <= row["intervals"]["before"][1]
                for row in some
            ]
            held = [_text(share(row["held"][gap] for row in some)) for gap in GAPS]
            lines.append((name, len(some), *held, _text(share(alike))))
    return table(head, lines)


def _text(counted: Share) -> str:
    low, high = counted.interval
    return f"{counted.value:.3f} [{low:.3f}, {high:.3f}]"


def _bin(value: float, edges: Sequence[float]) -> str:
    low = [edge for edge in edges if edge <= value]
    high = [edge for edge in edges if edge > value]
    if not high:
        return f"{low[-1]:g} or more"
    return f"below {high[0]:g}" if not low else f"{low[-1]:g} to {high[0]:g}"
