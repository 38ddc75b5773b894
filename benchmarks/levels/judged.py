"""Diagnoses a small recording, in this process, and compares its gaps with the truth.

The true gaps are those of `benchmarks.renewed.remains`. The oracle's gap before, with all pixels
alike, stands beside them.
"""

import time
from pathlib import Path
from typing import Any

import torch

from benchmarks.levels.cases import Case
from benchmarks.renewed.remains import OPTIONS, true_gaps_mm
from benchmarks.withheld.oracle import ask
from benchmarks.withheld.reading import read
from tofcorr.data.recording import Recording
from tofcorr.diagnosis.findings.gap import Gap, draw_resamples, measure_gap
from tofcorr.diagnosis.findings.naming import NamedEffects
from tofcorr.diagnosis.findings.open_set import OpenSet, judge_remainder, name_in_two
from tofcorr.diagnosis.prepare import prepare
from tofcorr.diagnosis.sums.study import Study

EDGE_MM = 5e-4  # of a report: three digits


def judge(case: Case, folder: Path) -> dict[str, Any]:
    """Return what is true of a case and what the diagnosis says."""
    data = read(folder)
    start = time.process_time()
    study, named, gap, left = diagnosed(folder)
    seconds = time.process_time() - start
    oracle = ask(data, case.fields, case.expected)
    before, after = true_gaps_mm(study, named, data.depth - case.expected)
    true = {"before": before, "after": after, "closed": max(1 - (after / before) ** 2, 0.0)}
    said = {
        "before": [1e3 * x for x in gap.before_interval],
        "after": [1e3 * x for x in gap.after_interval],
        "closed": list(gap.closed_interval),
    }
    return {
        **case.about,
        "size_mm": case.size_mm,
        "sizes_mm": case.sizes_mm,
        "must_find": [form.effect for form in case.forms if oracle.must_find(form.effect)],
        "names": named.names,
        "sets": named.cause_sets,
        "tested": named.tested,
        "unknown": left.unknown,
        "p_values": dict(left.p_values),
        "p_value": left.p_value,
        "gap_mm": {"before": 1e3 * gap.before, "after": 1e3 * gap.after, "floor": 1e3 * gap.floor},
        "closed": gap.closed,
        "intervals": said,
        "truth": true,
        "before_all_alike_mm": oracle.plain.before_mm,
        "held": {name: _holds(said[name], value) for name, value in true.items()},
        "seconds": seconds,
    }


def diagnosed(folder: Path) -> tuple[Study, NamedEffects, Gap, OpenSet]:
    """Run the steps of `tofcorr diagnose` that name effects, measure gaps and judge the rest."""
    study = prepare(Recording.open(folder), OPTIONS).study
    resamples = draw_resamples(study, torch.Generator().manual_seed(OPTIONS.seed + 1))
    named = name_in_two(study, resamples)
    gap = measure_gap(study, named, resamples)
    return study, named, gap, judge_remainder(study, named, gap)


def _holds(interval: list[float], value: float) -> bool:
    return interval[0] - EDGE_MM <= value <= interval[1] + EDGE_MM
