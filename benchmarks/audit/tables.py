"""The answers as text: a line a recording, and a table with a line a row."""

from collections import Counter
from collections.abc import Sequence
from typing import Any

from benchmarks.audit.judged import RIGHT, SET, WARNING, WRONG
from benchmarks.audit.rows import ROWS
from benchmarks.renewed.tables import table as markdown

Draw = dict[str, Any]
ANSWERS = (RIGHT, SET, WARNING, WRONG)


def line(draw: Draw) -> str:
    """One recording: truth, gap before and after, what is said, the judgement."""
    true = draw["true"]
    sizes = " + ".join(f"{name} {size:.1f}" for name, size in true["sizes_mm"].items())
    start = f"{draw['row']} {draw['number']}: {sizes or 'nothing'} mm, {true['left_mm']:.1f} left"
    if "refused" in draw:
        return f"{start} | refused: {draw['refused']} | {draw['judged']}"
    gaps = " -> ".join(_interval(draw[name]) for name in ("before_mm", "after_mm"))
    sets = " ".join("{" + ", ".join(members) + "}" for members in draw["sets"]) or "nothing named"
    said = [
        start,
        f"{gaps} over {draw['floor_mm']:.1f} (truly {true['noise_mm']:.1f})",
        sets,
        f"{'UNKNOWN' if draw['unknown'] else 'not unknown'}, p {draw['unknown_p']:.3g}",
        *draw["warnings"],
        *(f"likeliest {name}" for name in draw["likeliest"]),
        draw["judged"],
    ]
    return " | ".join(said)


def table(draws: Sequence[Draw]) -> str:
    """How often each row is answered how."""
    rows = []
    for name in dict.fromkeys(draw["row"] for draw in draws):
        of_row = [draw for draw in draws if draw["row"] == name]
        answers = Counter(draw["judged"] for draw in of_row)
        rows.append((ROWS[name].about, len(of_row), *(answers[answer] or "" for answer in ANSWERS)))
    return markdown(("row", "n", *ANSWERS), rows)


def _interval(values: Sequence[float]) -> str:
    value, low, high = values
    return f"{value:.1f} [{low:.1f}, {high:.1f}]"
