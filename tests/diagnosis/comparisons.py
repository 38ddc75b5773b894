"""Effects side by side, made up, and models of them."""

from typing import Any

import torch

from tofcorr.diagnosis.findings.effect_comparison import EffectComparison, EffectTest
from tofcorr.diagnosis.findings.gap import resampled
from tofcorr.diagnosis.findings.naming import NamedEffects
from tofcorr.diagnosis.sums.study import Study


def side_by_side(closed: dict[str, float], chosen: tuple[str, ...] = ()) -> EffectComparison:
    """Return effects that close so much of ten units, the same in each of forty poses."""
    each = torch.ones(40, dtype=torch.float64) / 40
    tests = {name: effect_test(name, total * each) for name, total in closed.items()}
    return EffectComparison(chosen=chosen, squares=10.0 * each, tests=tests, probes={})


def effect_test(name: str, closed: torch.Tensor, **changes: Any) -> EffectTest:
    """Return a test that gains what it closes; by chance that is between -1 and 1."""
    null = torch.linspace(-1.0, 1.0, 99, dtype=torch.float64)
    known = {"gain": float(closed.sum()), "null": null, "size": 5} | changes
    return EffectTest(name=name, closed=closed, **known)


def resamples_of(study: Study, seed: int = 1) -> torch.Tensor:
    """Draw how often each resample of a study holds each pose."""
    generator = torch.Generator().manual_seed(seed)
    return resampled(study.sums.num_units, study.options.bootstraps, generator)


def model_of(study: Study, last: EffectComparison | None = None, **changes: Any) -> NamedEffects:
    """Return a model of a study, from how effects compare as additions to it."""
    last = last or side_by_side({})
    return NamedEffects(study=study, first=last, last=last, **changes)
