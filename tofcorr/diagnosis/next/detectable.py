"""The smallest size of each effect that a recording would have shown."""

import numpy as np
import torch
from torch import Tensor

from tofcorr.diagnosis.findings.absorption import absorbed_share, left_over
from tofcorr.diagnosis.findings.effect_comparison import NORMAL_95, EffectTest
from tofcorr.diagnosis.findings.naming import NamedEffects
from tofcorr.diagnosis.sums.study import Study
from tofcorr.simulation.effects import CATALOGUE

# Standard normal quantile of 80 % power. The usual choice in the design of experiments.
_POWER_QUANTILE = 0.8416
# Random directions in the space of an effect's coefficients, whose median is reported. Chosen.
_DRAWS = 64
# Above this absorbed share an effect is not identifiable: the rest is rounding error. Chosen.
_NOT_IDENTIFIABLE = 0.999
# Added to the diagonal of the base model's system, as a share of its weights, so that it can be
# solved. Chosen, four digits above the rounding of float64.
_RIDGE = 1e-12


def minimum_detectable(study: Study, named: NamedEffects, seed: int) -> dict[str, float | None]:
    """Return the size of each effect that would be found with 80 % probability, metres.

    The size is the root mean square of the effect's signal over all pixels, before base model and
    hand-eye transform absorb their share. None: the effect is not identifiable, because they absorb
    all of it.

    Args:
        study: The recording.
        named: The effects named.
        seed: Of the random directions.
    """
    generator = torch.Generator().manual_seed(seed)
    critical = named.first.critical_score(0.05)
    sizes: dict[str, float | None] = {}
    for name, test in named.first.tests.items():
        if name in study.candidates.effects:
            sizes[name] = _of_columns(study, test, critical, generator)
        else:
            sizes[name] = _of_map(study, test, critical)
    return sizes


def noncentrality(test: EffectTest, critical: float) -> float:
    """Return the noncentrality that lifts the gain above its critical value in 80 % of cases."""
    middle, high = _middle_and_high(test)
    threshold = middle + critical * (high - middle) / NORMAL_95
    level = max(threshold - middle, 1.0)
    return (_POWER_QUANTILE + float(np.sqrt(_POWER_QUANTILE**2 + level))) ** 2


def _middle_and_high(test: EffectTest) -> tuple[float, float]:
    """Return the median and the 95 % quantile of a test's null distribution."""
    middle, high = torch.quantile(test.null, test.null.new_tensor([0.5, 0.95])).tolist()
    return middle, high


def _of_columns(
    study: Study, test: EffectTest, critical: float, generator: torch.Generator
) -> float | None:
    gls, ols = study.sums.gls, study.sums.ols
    if absorbed_share(study, test.name) > _NOT_IDENTIFIABLE:
        return None
    low, high = ols.layout.effects[test.name]
    members = torch.arange(study.fit.model.num_columns)
    prior = ols.layout.prior_of(members)
    seen = left_over(gls.total, members, low, high, prior)
    plain = ols.total / (ols.scale * study.sums.count.sum())
    raw = plain[low:high, low:high]
    ridge = _RIDGE * torch.eye(len(members), dtype=torch.float64)
    left = left_over(plain, members, low, high, ridge)
    directions = torch.randn(_DRAWS, high - low, generator=generator, dtype=torch.float64)
    signal = _quadratic(directions, seen).clamp(min=1e-30)
    size = _quadratic(directions, raw)
    remains = _quadratic(directions, left).clamp(min=1e-30)
    detectable = (size / signal * noncentrality(test, critical)).sqrt()
    tests = study.options.tests
    least = tests.form_tolerance_mm if CATALOGUE[test.name].refines else study.material_mm
    reportable = (size / remains).sqrt() * least * 1e-3
    return float(torch.maximum(detectable, reportable).median())


def _quadratic(directions: Tensor, matrix: Tensor) -> Tensor:
    return torch.einsum("di,ij,dj->d", directions, matrix, directions)


def _of_map(study: Study, test: EffectTest, critical: float) -> float:
    """Return the size of a map of independent values that would be found, metres."""
    precision = float(study.weight.sum())
    middle, high = _middle_and_high(test)
    threshold = critical * (high - middle) / NORMAL_95 + (high - middle)
    detectable = np.sqrt(max(threshold, 1.0) / precision)
    return float(max(detectable, study.material_mm * 1e-3))
