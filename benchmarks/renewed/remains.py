"""What is true of the gaps in a report: what its models leave of the distances without noise.

The diagnosis is run again in this process. Base model and effects are fitted as there, to the noisy
distances; each pose, or tile of an image where the report uses tiles, is predicted by the fit to
all others, and compared with its distances without noise. Pixels count as in the report: outliers
do not, noisy ones less. So a report that knew the noise of every pixel would state these gaps
exactly.
"""

import json
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from benchmarks.withheld.generator.rigid import Array
from benchmarks.withheld.outcomes import Outcome, load
from benchmarks.withheld.reading import read
from tofcorr.data.recording import Recording
from tofcorr.diagnosis.findings.gap import draw_resamples
from tofcorr.diagnosis.findings.naming import NamedEffects
from tofcorr.diagnosis.findings.open_set import name_in_two
from tofcorr.diagnosis.options import DiagnosisOptions
from tofcorr.diagnosis.prepare import prepare
from tofcorr.diagnosis.sums.linear_system import tile_sums
from tofcorr.diagnosis.sums.study import Study

OPTIONS = DiagnosisOptions(simulate_anew=False, page=False)


def waiting(out: Path) -> list[str]:
    """Recordings that were diagnosed, and of which the truth is known but not yet measured."""
    entries = json.loads((out / "manifest.json").read_text())["recordings"]
    return [
        name
        for name in (entry["id"] for entry in entries)
        if (out / "diagnoses" / name / "diagnosis.json").exists()
        and (out / "answers" / name / "expected.npy").exists()
        and not (out / "truths" / f"{name}.json").exists()
    ]


def measure(out: Path, names: Sequence[str], workers: int) -> Iterator[bool]:
    """Write `out/truths` of these recordings; yield whether each names what its report names."""
    (out / "truths").mkdir(exist_ok=True)
    with ProcessPoolExecutor(workers) as pool:
        yield from pool.map(partial(_measure_one, out), names)


def _measure_one(out: Path, name: str) -> bool:
    folder = out / "recordings" / name
    study = prepare(Recording.open(folder), OPTIONS).study
    resamples = draw_resamples(study, torch.Generator().manual_seed(OPTIONS.seed + 1))
    named = name_in_two(study, resamples)
    before, after = true_gaps_mm(study, named, read(folder).depth - load(out, name, "expected"))
    report = json.loads((out / "diagnoses" / name / "diagnosis.json").read_text())
    truth = {"effects": list(named.names), "before_mm": before, "after_mm": after}
    (out / "truths" / f"{name}.json").write_text(json.dumps(truth))
    return report["effects"] == truth["effects"]


def true_gaps_mm(study: Study, named: NamedEffects, noise: Array) -> tuple[float, float]:
    """Return the gaps before and after the effects named, with this noise (N, H, W), metres."""
    before = _left_mm(study, (), noise)
    return before, _left_mm(named.study, named.columns, noise) if named.names else before


def true_gaps(one: Outcome, out: Path) -> tuple[float | None, float | None]:
    """The true gaps of a report, millimetres; None where they were not measured.

    They were not where the program that measured names other effects than the report.
    """
    file = out / "truths" / f"{one.name}.json"
    truth = json.loads(file.read_text()) if file.exists() else {}
    if one.said.failure or tuple(truth.get("effects", "?")) != one.said.effects:
        return None, None
    return truth["before_mm"], truth["after_mm"]


def _left_mm(study: Study, names: Sequence[str], noise: Array) -> float:
    observations, sums, unit = study.observations, study.sums, study.unit_of_pixel
    if study.tiles is not None and any(map(study.candidates.is_tested_by_tiles, names)):
        sums, unit = tile_sums(study.system, names, study.tiles, study.fit), _unit_of_pixel(study)
    theta = sums.ols.left_out_coefficients(names)[unit]
    left, start = study.system.residual.clone(), 0
    for part in study.system.of(names):
        left -= (part * theta[:, start : start + part.shape[1]]).sum(1)
        start += part.shape[1]
    own = noise.reshape(len(noise), -1)[observations.frame.numpy(), observations.pixel.numpy()]
    share = study.fit.share.numpy() * np.isfinite(own)
    squares = (left.numpy() - np.nan_to_num(own)) ** 2
    return 1e3 * float(np.sqrt((share * squares).sum() / share.sum()))


def _unit_of_pixel(study: Study) -> Tensor:
    """The whole pose or tile that each pixel belongs to, shape (M,)."""
    tiles = study.tiles
    assert tiles is not None
    unit = torch.searchsorted(tiles.whole, study.unit_of_pixel)
    counts = torch.tensor(tiles.counts)
    unit[tiles.pixels] = len(tiles.whole) + torch.arange(len(counts)).repeat_interleave(counts)
    return unit
