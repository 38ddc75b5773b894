"""Diagnoses a recording of a row in this process, and judges the answer by what is true."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from benchmarks.audit.rows import ROWS, Made
from benchmarks.withheld.oracle import ask, counted
from benchmarks.withheld.reading import read
from tofcorr.diagnosis.diagnose import diagnose
from tofcorr.errors import TofcorrError

RIGHT, SET, WARNING, WRONG = "right", "set holds it", "warning says why", "WRONG"
CONFIG = {"page": False, "simulate_anew": False}


def judge(name: str, made: Made, folder: Path) -> dict[str, Any]:
    """Return what is true of a recording, what the diagnosis says, and the judgement."""
    true = {
        "effects": list(made.effects),
        "sizes_mm": dict(made.sizes_mm),
        "left_mm": _left_mm(made, folder),
    }
    try:
        said = _said(folder)
    except TofcorrError as error:
        return {"true": true, "refused": str(error), "judged": WARNING}
    return {"true": true, **said, "judged": _judged(made.effects, said, ROWS[name].says)}


def _left_mm(made: Made, folder: Path) -> float:
    """The true gap that recalibration leaves, as pixels count in a report; 0 without an effect."""
    if not made.effects:
        return 0.0
    oracle = ask(read(folder), made.fields, made.expected, counted(made.noise))
    assert oracle.counted is not None
    return oracle.counted.before_mm


def _said(folder: Path) -> dict[str, Any]:
    result = diagnose(folder, config=CONFIG)
    gap = result.gap
    return {
        "before_mm": [1e3 * x for x in (gap.before, *gap.before_interval)],
        "after_mm": [1e3 * x for x in (gap.after, *gap.after_interval)],
        "floor_mm": 1e3 * gap.floor,
        "sets": [list(members) for members in result.cause_sets],
        "likeliest": list(result.likeliest),
        "unknown": result.unknown,
        "unknown_p": result.remainder.p_value,
        "verdict": result.verdict,
        "remarks": list(result.remarks),
        "warnings": list(result.warnings),
        "missing": sorted(result.missing),
    }


def _judged(truth: Sequence[str], said: dict[str, Any], needed: str) -> str:
    """The judgement, the strictest first.

    A set without a true effect is wrong, whatever else is said; so is silence about an effect, and
    a missing warning where one is needed. "Unknown" is a warning where an effect is missing.
    """
    sets = said["sets"]
    warned = not needed or any(needed in text for text in said["warnings"])
    if any(not set(members) & set(truth) for members in sets) or not warned:
        return WRONG
    if not truth:
        silent = not sets and not said["unknown"]
        return WRONG if not silent else WARNING if needed else RIGHT
    held = [any(effect in members for members in sets) for effect in truth]
    if all(held):
        return RIGHT if all(members[0] in truth for members in sets) else SET
    return WARNING if said["unknown"] else WRONG
