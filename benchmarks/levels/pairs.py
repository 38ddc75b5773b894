"""The table of recordings with two effects: are both named, and what do their sets hold?"""

from collections.abc import Mapping, Sequence
from typing import Any

from benchmarks.renewed.scoring import LEAST_MM, PART_OF
from benchmarks.renewed.tables import table
from benchmarks.withheld.statistics import Share, share

Row = Mapping[str, Any]


def pairs_table(rows: Sequence[Row]) -> str:
    """Return it as Markdown; empty without such recordings."""
    if not rows:
        return ""
    named = [_known(row["names"]) for row in rows]
    sets = [[_known(members) for members in row["sets"]] for row in rows]
    true = [set(row["sizes_mm"]) for row in rows]
    asked = [_asked(row) for row in rows]
    right = sum(len(some & all_) for some, all_ in zip(named, true, strict=True))
    wrong = sum(len(some - all_) for some, all_ in zip(named, true, strict=True))
    missed = sum(len(some - own) for some, own in zip(asked, named, strict=True))
    sizes = [len(one) for own in sets for one in own]
    held = share(
        any(effect in one for one in own)
        for own, some in zip(sets, asked, strict=True)
        for effect in some
    )
    single = share(
        any(len(one) == 1 and not one & all_ for one in own)
        for own, all_ in zip(sets, true, strict=True)
    )
    figures = [
        ("effects named: right, wrong, missed", f"{right}, {wrong}, {missed}"),
        ("F1 of the names", f"{2 * right / max(2 * right + wrong + missed, 1):.3f}"),
        ("effects to be found that are in a set", _text(held)),
        ("a single wrong name", _text(single)),
        ("size of a set", f"{sum(sizes) / max(len(sizes), 1):.2f}"),
    ]
    return table((f"{len(rows)} pairs of effects", ""), figures)


def _known(names: Sequence[str]) -> set[str]:
    """The names that the check uses."""
    return {PART_OF.get(name, name) for name in names}


def _asked(row: Row) -> set[str]:
    """The effects of 2 mm or more that the oracle finds."""
    return {name for name in row["must_find"] if row["sizes_mm"][name] >= LEAST_MM}


def _text(counted: Share) -> str:
    low, high = counted.interval
    return f"{counted.value:.3f} [{low:.3f}, {high:.3f}], n = {counted.total}"
