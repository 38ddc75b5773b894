"""Diagnoses a recording of a row in this process, and judges the answer by what is true."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.audit.rows import ROWS, Made
from benchmarks.withheld.oracle import ask, counted
from benchmarks.withheld.reading import Data, read
from tofcorr.diagnosis.diagnose import diagnose
from tofcorr.errors import TofcorrError

RIGHT, SET, WARNING, WRONG = "right", "set holds it", "warning says why", "WRONG"
CONFIG = {"page": False, "simulate_anew": False}


def judge(name: str, made: Made, folder: Path) -> dict[str, Any]:
    """Return what is true of a recording, what the diagnosis says, and the judgement."""
    data = read(folder)
    true = {
        "effects": list(made.effects),
        "sizes_mm": dict(made.sizes_mm),
        "left_mm": _left_mm(made, data),
        "noise_mm": _noise_mm(made, data),
    }
    try:
        said = _said(folder)
    except TofcorrError as error:
        return {"true": true, "refused": str(error), "judged": WARNING}
    return {"true": true, **said, "judged": judged(made.effects, said, ROWS[name].says)}


def _left_mm(made: Made, data: Data) -> float:
    """The true gap that recalibration leaves, as pixels count in a report; 0 without an effect."""
    if not made.effects:
        return 0.0
    oracle = ask(data, made.fields, made.expected, counted(made.noise))
    assert oracle.counted is not None
    return oracle.counted.before_mm


def _noise_mm(made: Made, data: Data) -> float:
    """The noise over the target's pixels, as they count in a report."""
    sigma = made.noise[data.valid]
    count = counted(sigma)
    return 1e3 * float(np.sqrt((count * sigma**2).sum() / count.sum()))


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


def judged(truth: Sequence[str], said: dict[str, Any], needed: str) -> str:
    """The judgement.

    A set without a true effect is wrong, whatever else is said; so is silence about an effect, and
    a missing warning where one is needed. "Unknown" is a warning where an effect is missing.
    """
    sets = [set(members) for members in said["sets"]]
    warned = not needed or any(needed in text for text in said["warnings"])
    if not warned or any(not members & set(truth) for members in sets):
        return WRONG
    if not truth:
        return WRONG if sets or said["unknown"] else WARNING if needed else RIGHT
    if set(truth) <= set().union(*sets):
        return RIGHT if all(len(members) == 1 for members in sets) else SET
    return WARNING if said["unknown"] else WRONG
