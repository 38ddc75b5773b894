"""Effects side by side, made up."""

import torch

from tofcorr.diagnosis.findings.effect_comparison import EffectComparison, EffectTest


def side_by_side(closed: dict[str, float], chosen: tuple[str, ...] = ()) -> EffectComparison:
    """Return effects that close so much of ten units, the same in each of forty poses."""
    null = torch.linspace(-1.0, 1.0, 99, dtype=torch.float64)
    each = torch.ones(40, dtype=torch.float64) / 40
    tests = {
        name: EffectTest(name=name, closed=total * each, gain=total, null=null, size=5)
        for name, total in closed.items()
    }
    return EffectComparison(chosen=chosen, squares=10.0 * each, tests=tests, probes={})
