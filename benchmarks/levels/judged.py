"""Diagnoses a small recording, in this process, and compares its gaps with the truth.

The gap before is the oracle's: its own fit, against the distances without noise. The gap after is
what the final model of the diagnosis leaves of these distances, each pose predicted by the others.
Pixels count as a report says: outliers do not, noisy ones less. The gap before with all pixels
alike stands beside it.
"""

import time
from pathlib import Path
from typing import Any

import numpy as np
import torch

from benchmarks.levels.cases import Case
from benchmarks.withheld.generator.rigid import Array
from benchmarks.withheld.oracle import ask, counted
from benchmarks.withheld.reading import read
from tofcorr.data.recording import Recording
from tofcorr.diagnosis.findings.how_far import Gap, measure_gap
from tofcorr.diagnosis.findings.naming import NamedEffects, name_effects
from tofcorr.diagnosis.findings.open_set import OpenSet, judge_remainder
from tofcorr.diagnosis.findings.resamples import draw_resamples
from tofcorr.diagnosis.options import DiagnosisOptions
from tofcorr.diagnosis.prepare import prepare
from tofcorr.diagnosis.sums.positive import solve_positive
from tofcorr.diagnosis.sums.study import Study

EDGE_MM = 5e-4  # of a report: three digits


def judge(case: Case, folder: Path) -> dict[str, Any]:
    """Return what is true of a case and what the diagnosis says."""
    data = read(folder)
    start = time.process_time()
    study, named, gap, left = diagnosed(folder)
    seconds = time.process_time() - start
    count = counted(case.noise) * _trust(study, case.noise.shape)
    oracle = ask(data, case.fields, case.expected, count)
    assert oracle.counted is not None
    before = oracle.counted.before_mm
    after = min(before, _left_mm(named, data.depth - case.expected, count))
    if not named.names:
        after = before
    true = {"before": before, "after": after, "closed": 1 - (after / before) ** 2}
    said = {
        "before": [1e3 * x for x in gap.before_interval],
        "after": [1e3 * x for x in gap.after_interval],
        "closed": list(gap.closed_interval),
    }
    return {
        **case.about,
        "size_mm": case.size_mm,
        "findable": case.form is not None and oracle.must_find(case.form.effect),
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
    options = DiagnosisOptions(simulate_anew=False, page=False)
    study = prepare(Recording.open(folder), options).study
    named = name_effects(study)
    generator = torch.Generator().manual_seed(options.seed + 1)
    gap = measure_gap(study, named, draw_resamples(study, generator))
    return study, named, gap, judge_remainder(study, named, gap)


def _trust(study: Study, shape: tuple[int, ...]) -> Array:
    """Return the weight of each pixel as no outlier, (N, H, W)."""
    observations, trust = study.observations, np.ones(shape)
    flat = trust.reshape(shape[0], -1)
    flat[observations.frame.numpy(), observations.pixel.numpy()] = study.fit.trust.numpy()
    return trust


def _left_mm(named: NamedEffects, noise: Array, count: Array) -> float:
    """Return what the final model leaves of the distances without noise, each pose held out."""
    study = named.study
    observations, blocks = study.observations, study.system.blocks
    gram, score, prior = blocks.even.of(named.columns)
    others = gram.sum(0) + prior - gram, (score.sum(0) - score)[:, :, None]
    theta = solve_positive(*others)[..., 0][observations.unit[observations.frame]]
    left, start = study.system.residual.clone(), 0
    for part in study.system.columns.of(named.columns):
        left -= (part * theta[:, start : start + part.shape[1]]).sum(1)
        start += part.shape[1]
    place = observations.frame.numpy(), observations.pixel.numpy()
    own = noise.reshape(len(noise), -1)[place]
    weight = count.reshape(len(count), -1)[place] * np.isfinite(own)
    squares = (left.numpy() - np.nan_to_num(own)) ** 2
    return 1e3 * float(np.sqrt((weight * squares).sum() / weight.sum()))


def _holds(interval: list[float], value: float) -> bool:
    return interval[0] - EDGE_MM <= value <= interval[1] + EDGE_MM
