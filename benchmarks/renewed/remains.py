"""What the effects that a diagnosis named leave of the gap, measured without noise.

A second diagnosis sees the same recording by a perfect robot and an almost noiseless camera, with
a catalogue of the effects named alone. Nothing of its selection is used: what remains there is what
these effects, as the program models them, cannot explain. Nothing was named: all remains. Noisy
pixels count less, as in the report.
"""

import json
import math
from pathlib import Path
from typing import Any

from benchmarks.renewed.cases import EXACT
from benchmarks.withheld.outcomes import Outcome


def named_again(out: Path) -> list[dict[str, Any]]:
    """Entries for `diagnose`: the noiseless recordings of those in which something was named."""
    entries = []
    for entry in json.loads((out / "manifest.json").read_text())["recordings"]:
        name = entry["id"] + EXACT
        if (out / "runs" / f"{name}.json").exists() or not (out / "recordings" / name).exists():
            continue
        report = out / "diagnoses" / entry["id"] / "diagnosis.json"
        named = json.loads(report.read_text())["effects"] if report.exists() else []
        if named:
            entries.append(
                {"id": name, "exclude": [], "config": f"catalogue: {json.dumps(named)}\n"}
            )
    return entries


def true_gaps(one: Outcome, out: Path) -> tuple[float | None, float | None]:
    """The gap before and with the effects named, millimetres; None where it was not measured.

    What remains without noise and what the oracle leaves (robot, uncertainty of the fit) add up
    as squares.
    """
    oracle = one.oracle.counted or one.oracle.plain
    before = oracle.before_mm
    if math.isnan(before) or one.said.failure:
        return None, None
    if not one.said.effects or not one.truths:  # nothing was there to be closed
        return before, before
    file = out / "diagnoses" / (one.name + EXACT) / "diagnosis.json"
    if not file.exists():
        return before, None
    left = json.loads(file.read_text())["gap_mm"]["after"]
    return before, min(before, math.hypot(left, oracle.after_mm))
