"""What these data could have shown, and what to record next."""

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from tofcorr.diagnosis.select import Selection
from tofcorr.diagnosis.study import BASE_FORMS, Study
from tofcorr.diagnosis.which import EffectTest, absorbed_share
from tofcorr.simulation.effects import CATALOGUE

# The normal quantile of 80 % power.
_POWER_QUANTILE = 0.8416
_DRAWS = 64
# Of a signal that base model and hand-eye take up to this share nothing can be said.
_ALL = 0.999


def minimum_detectable(study: Study, selection: Selection, seed: int) -> dict[str, float | None]:
    """Return for every effect the size that would be found with 80 % probability, metres.

    The size is the root mean square of the effect's own signal over all pixels, before base model
    and hand-eye take up their part. None: base model and hand-eye take up all of it.
    """
    generator = torch.Generator().manual_seed(seed)
    critical = _critical_score(selection)
    sizes: dict[str, float | None] = {}
    for name, test in selection.first.tests.items():
        if name in study.effects:
            sizes[name] = _of_columns(study, test, critical, generator)
        else:
            sizes[name] = _of_map(study, test, critical)
    return sizes


def next_recording(
    selection: Selection, missing: dict[str, list[str]], sizes: dict[str, float | None]
) -> list[str]:
    """Return what to record so that more can be told, the most useful first."""
    advice: list[str] = []
    for members in selection.sets:
        if len(members) > 1:
            listed = " from ".join([members[0], ", ".join(members[1:])])
            advice.append(f"To tell {listed}: {CATALOGUE[members[0]].remedy}.")
            advice += [f"Also for {other}: {CATALOGUE[other].remedy}." for other in members[1:]]
    hidden = [name for name, size in sizes.items() if size is None]
    advice += [
        f"{name} cannot be seen in these data, base model and hand-eye take up all of it: "
        f"{CATALOGUE[name].remedy}."
        for name in hidden
    ]
    advice += [
        f"{name} could not be judged; record {', '.join(wants)}: {CATALOGUE[name].remedy}."
        for name, wants in missing.items()
    ]
    return advice


def _critical_score(selection: Selection) -> float:
    """Return the score that the best effect must reach, from the flips of all effects."""
    best = torch.stack([t.null_scores() for t in selection.first.tests.values()]).amax(0)
    return float(torch.quantile(best, 0.95))


def _needed(test: EffectTest, critical: float) -> float:
    """Return the noncentrality that brings the gain over its critical value in 80 % of cases."""
    threshold = float(test.null.mean() + critical * test.null.std())
    overhead = max(-float(test.null.mean()), 0.0)
    level = max(threshold + overhead, 1.0)
    return (_POWER_QUANTILE + float(np.sqrt(_POWER_QUANTILE**2 + level))) ** 2


def _of_columns(
    study: Study, test: EffectTest, critical: float, generator: torch.Generator
) -> float | None:
    likely, even = study.blocks.likely, study.blocks.even
    if absorbed_share(study, test.name) > _ALL:
        return None
    low, high = even.layout.effects[test.name]
    members = torch.arange(even.layout.base)
    seen = _left_over(likely.gram.sum(0), members, low, high, even.layout.prior[members])
    plain = even.gram.sum(0) / (study.blocks.even_scale * study.blocks.count.sum())
    raw = plain[low:high, low:high]
    left = _left_over(plain, members, low, high, 1e-12 * torch.ones(len(members)).double())
    directions = torch.randn(_DRAWS, high - low, generator=generator, dtype=torch.float64)
    signal = _quadratic(directions, seen).clamp(min=1e-30)
    size = _quadratic(directions, raw)
    remains = _quadratic(directions, left).clamp(min=1e-30)
    detectable = (size / signal * _needed(test, critical)).sqrt()
    tests = study.options.tests
    material = tests.form_tolerance_mm if test.name in BASE_FORMS else tests.material_mm
    nameable = (size / remains).sqrt() * material * 1e-3
    return float(torch.maximum(detectable, nameable).median())


def _left_over(gram: Tensor, members: Tensor, low: int, high: int, prior: Tensor) -> Tensor:
    """Return the Gram matrix of an effect after the base model took its part."""
    inner = gram[members][:, members] + torch.diag(prior)
    cross = gram[members, low:high]
    return gram[low:high, low:high] - cross.T @ torch.linalg.solve(inner, cross)


def _quadratic(directions: Tensor, matrix: Tensor) -> Tensor:
    return torch.einsum("di,ij,dj->d", directions, matrix, directions)


def _of_map(study: Study, test: EffectTest, critical: float) -> float:
    """A map of independent values: each cell is as precise as its pixels together."""
    precision = float(study.weight.sum())
    threshold = float(test.null.mean() + critical * test.null.std())
    noise = float(test.null.std())
    detectable = np.sqrt(max(threshold - float(test.null.mean()) + noise, 1.0) / precision)
    return float(max(detectable, study.options.tests.material_mm * 1e-3))


def describe_missing(missing: dict[str, list[str]]) -> Sequence[str]:
    """Return one sentence an effect that could not be judged."""
    return [f"{name}: needs {', '.join(wants)}" for name, wants in missing.items()]
