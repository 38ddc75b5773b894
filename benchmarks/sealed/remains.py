"""What is true of the gaps in a report: what its models leave of the distances without noise.

The diagnosis is run again in this process. Base model and effects are fitted as there, to the noisy
distances; each pose is predicted by the fit to all others, and compared with its distances without
noise. Pixels count as in the report: outliers do not, noisy ones less. So a report that knew the
noise of every pixel would state these gaps exactly.
"""

import json
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from pathlib import Path

import numpy as np
import torch

from benchmarks.renewed.geometry import Array
from benchmarks.renewed.recording import read
from benchmarks.sealed.answers import Outcome, entries_of, load
from tofcorr.data.recording import Recording
from tofcorr.diagnosis.diagnose import prepare
from tofcorr.diagnosis.findings.gap import (
    Gap,
    OpenSet,
    judge_remainder,
    measure_gap,
    resampled,
)
from tofcorr.diagnosis.findings.naming import NamedEffects, name_effects
from tofcorr.diagnosis.options import DiagnosisOptions
from tofcorr.diagnosis.sums.study import Study

OPTIONS = DiagnosisOptions(simulate_anew=False, page=False)


def diagnosed(
    folder: Path, options: DiagnosisOptions = OPTIONS
) -> tuple[Study, NamedEffects, Gap, OpenSet]:
    """Run the steps of `tofcorr diagnose` that name effects, measure gaps and judge the rest."""
    study = prepare(Recording.open(folder), options).study
    generator = torch.Generator().manual_seed(options.seed + 1)
    resamples = resampled(study.sums.num_units, options.bootstraps, generator)
    named = name_effects(study)
    gap = measure_gap(study, named, resamples)
    return study, named, gap, judge_remainder(study, named, gap)


def waiting(out: Path) -> list[str]:
    """Recordings that were diagnosed, and of which the truth is known but not yet measured."""
    return [
        name
        for name in (entry["id"] for entry in entries_of(out))
        if (out / "diagnoses" / name / "diagnosis.json").exists()
        and (out / "answers" / name / "expected.npy").exists()
        and not (out / "truths" / f"{name}.json").exists()
    ]


def measure(out: Path, names: Sequence[str], jobs: int) -> Iterator[bool]:
    """Write `out/truths` of these recordings; yield whether each names what its report names."""
    (out / "truths").mkdir(exist_ok=True)
    with ProcessPoolExecutor(jobs) as pool:
        yield from pool.map(partial(_measure_one, out), names)


def _measure_one(out: Path, name: str) -> bool:
    folder = out / "recordings" / name
    study, named, _, _ = diagnosed(folder)
    before, after = true_gaps_mm(study, named, read(folder).depth - load(out, name, "expected"))
    report = json.loads((out / "diagnoses" / name / "diagnosis.json").read_text())
    truth = {"effects": list(named.names), "before_mm": before, "after_mm": after}
    (out / "truths" / f"{name}.json").write_text(json.dumps(truth))
    return report["effects"] == truth["effects"]


def true_gaps_mm(study: Study, named: NamedEffects, noise: Array) -> tuple[float, float]:
    """Return the gaps before and after the effects named, with this noise (N, H, W), metres."""
    before = _left_mm(study, (), noise)
    return before, _left_mm(named.study, named.columns, noise) if named.names else before


def covered(one: Outcome, out: Path) -> dict[str, bool]:
    """Whether each interval of a report holds the truth; empty where that was not measured.

    It was not where the program that measured names other effects than the report. A report
    without an interval does not hold it.
    """
    file = out / "truths" / f"{one.name}.json"
    truth = json.loads(file.read_text()) if file.exists() else {}
    if one.said.failure or tuple(truth.get("effects", "?")) != one.said.effects:
        return {}
    before, after = truth["before_mm"], truth["after_mm"]
    true = {"before": before, "after": after, "closed": 1 - (after / before) ** 2}
    gaps = one.said.report["gap_mm"]
    return {name: _holds(gaps.get(f"{name}_ci"), value) for name, value in true.items()}


def _holds(interval: Sequence[float | None] | None, value: float) -> bool:
    if not interval or None in interval:
        return False
    low, high = interval
    return low <= value <= high  # type: ignore[operator]


def _left_mm(study: Study, names: Sequence[str], noise: Array) -> float:
    observations = study.observations
    theta = study.sums.ols.left_out_coefficients(names)[study.unit_of_pixel]
    left, start = study.residual.clone(), 0
    for part in study.columns_of(names):
        left -= (part * theta[:, start : start + part.shape[1]]).sum(1)
        start += part.shape[1]
    own = noise.reshape(len(noise), -1)[observations.frame.numpy(), observations.pixel.numpy()]
    share = study.fit.share.numpy() * np.isfinite(own)
    squares = (left.numpy() - np.nan_to_num(own)) ** 2
    return 1e3 * float(np.sqrt((share * squares).sum() / share.sum()))
