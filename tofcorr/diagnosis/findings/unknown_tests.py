"""The tests behind `unknown`: does more remain than poses, noise and the target gap allow?

Each test has a null hypothesis of its own; a weighted Bonferroni correction joins them. Four of
them ask whether anything remains. With nothing missing their p-values are uniform, and they have
nearly all of the level, so that the cause is then called unknown about as often as the level says.
The others ask whether more remains than matters.

What was shown to be smaller than half of the target gap is not unknown, however significant. Where
effects are named, neither is what was not shown to be larger than matters: the forms of effects are
never quite right.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from scipy import special

from tofcorr.diagnosis.findings.coherence import Coherence
from tofcorr.diagnosis.findings.effect_comparison import closed_square
from tofcorr.diagnosis.findings.effect_test import NORMAL_95
from tofcorr.diagnosis.findings.how_far import Gap
from tofcorr.diagnosis.findings.naming import NamedEffects
from tofcorr.diagnosis.findings.waves import Waves, unlike_waves
from tofcorr.diagnosis.findings.where import Region, Where

# The right causes leave little structure inside images: at most this share of what there was
# before, and this size, m^2. Chosen.
_MISFIT_SHARE = 1 / 3
_MISFIT_SIZE = 0.0003**2
# Share of the target gap that is enough where effects are named, and for a bias along a covariate.
# Chosen: a part of the gap matters from half of it on.
_HALF = 0.5
# What each test has of the level. Chosen: nearly all for those that are uniform with nothing
# missing; the others reject then almost never, and otherwise by far. Of 299 draws, p-values are
# multiples of 1/300: the shares of 5 % are four, one and five of these.
_WEIGHTS = {
    "probes": 0.27,
    "effects": 0.08,
    "covariates": 0.34,
    "waves": 0.28,
    "structure": 0.01,
    "poses": 0.01,
    "size": 0.01,
}


class Allowed(NamedTuple):
    """What may remain.

    Attributes:
        target: Size of a gap that does not matter, metres.
        poses: Variance of the poses that is no gap, m^2.
        poses_given: Whether a user stated it; else it was estimated, up to a prior's limit.
        share: Of the squared gap.
    """

    target: float
    poses: float
    poses_given: bool
    share: float


def unknown_p_values(
    named: NamedEffects,
    gap: Gap,
    structures: tuple[Coherence, Coherence],
    where: Where,
    allowed: Allowed,
) -> dict[str, float]:
    """Return the p-value of each test, by name.

    Args:
        named: The effects named.
        gap: Before and after them.
        structures: Of the residual of the base fit, and of what the effects leave.
        where: Bias of what the effects leave along all covariates.
        allowed: What may remain.
    """
    before, after = structures
    target = allowed.target * (_HALF if named.names else 1.0)
    p_values = {
        "structure": _within(named, before, after, target),
        "poses": _poses(named, after, target, allowed),
        "size": _size(gap, before, after, target, allowed),
    }
    most = beyond_poses(gap.after_interval[1], after, allowed.poses)
    if most <= (_HALF * allowed.target) ** 2:
        return p_values | dict.fromkeys(("probes", "effects", "waves", "covariates"), 1.0)
    least = allowed.target * (_HALF if named.names else 0.0)
    return p_values | {
        "probes": _probes(named),
        "effects": _effects(named, gap, after, allowed),
        "waves": _waves(
            unlike_waves(named.study, named.columns), _least_within(named, before, least)
        ),
        "covariates": _covariates(where.by_covariate(), least),
    }


def joined(p_values: Mapping[str, float]) -> float:
    """Return the p-value of all tests together (Bonferroni, weighted)."""
    return min(1.0, *(value / _WEIGHTS[name] for name, value in p_values.items()))


def beyond_poses(size: float, structure: Coherence, allowed: float) -> float:
    """Return the square of a gap without the pose variance that is no gap, m^2."""
    return max(size**2 - float(np.clip(structure.between, 0.0, allowed)), 0.0)


def _probes(named: NamedEffects) -> float:
    """A probe belongs to the model, or is significant where nothing is named."""
    found = [named.probe_p_values[name] for name in named.probes]
    if not named.names and named.last.probes:
        alone = replace(named.last, tests={})
        found.append(alone.family_p_value(max(alone.probes.values(), key=lambda t: t.score).name))
    return min(found, default=1.0)


def _effects(named: NamedEffects, gap: Gap, after: Coherence, allowed: Allowed) -> float:
    """Nothing is named, yet an effect is significant: it explains too little of what remains."""
    if (
        named.names
        or beyond_poses(gap.after, after, allowed.poses) <= (_HALF * allowed.target) ** 2
    ):
        return 1.0
    least = (named.study.options.tests.material_mm * 1e-3) ** 2
    tests = named.last.tests.values()
    large = [test.name for test in tests if closed_square(named.study, test) >= least]
    return min((named.last.naming_p_value(name) for name in large), default=1.0)


def _within(named: NamedEffects, before: Coherence, after: Coherence, target: float) -> float:
    """Structure within images is larger than what matters, or than right causes leave."""
    least = _least_within(named, before, target)
    return float(special.ndtr(-(after.within - least) / max(after.within_error, 1e-12)))


def _least_within(named: NamedEffects, before: Coherence, target: float) -> float:
    """Return the square of the structure within images that matters, m^2."""
    if not named.names:
        return target**2
    return min(target**2, max(_MISFIT_SHARE * before.within, _MISFIT_SIZE))


def _waves(found: Waves, least: float) -> float:
    """Slow waves over the image have unlike energies."""
    return found.p_value if found.square > least else 1.0


def _covariates(regions: Mapping[str, Sequence[Region]], target: float) -> float:
    """Some covariate shows a bias; `where` has adjusted the p-values for their number."""
    found = [1.0]
    for own in regions.values():
        bins = [region for region in own if not region.trend]
        square = float(np.mean([r.bias**2 - _error(r) ** 2 for r in bins])) if bins else 0.0
        trends = [
            (r.bias**2 - _error(r) ** 2) / 12 for r in own if r.trend
        ]  # Of a line from end to end.
        if max([square, *trends]) > target**2:
            found.append(min(region.p_value for region in own))
    return min(found)


def _error(region: Region) -> float:
    """Return the standard error of a bias; its simultaneous interval is wider."""
    return (region.interval[1] - region.interval[0]) / 2 / (2 * NORMAL_95)


def _poses(named: NamedEffects, after: Coherence, target: float, allowed: Allowed) -> float:
    """Poses scatter more than they may (chi-squared)."""
    least = allowed.poses
    if allowed.poses_given and not named.names:
        least += target**2
    poses = named.study.system.blocks.num_units
    return float(special.chdtrc(poses, poses * max(after.between, 0.0) / max(least, 1e-12)))


def _size(gap: Gap, before: Coherence, after: Coherence, target: float, allowed: Allowed) -> float:
    """More remains than the target and the poses together, and much of what there was (normal)."""
    left = beyond_poses(gap.after, after, allowed.poses)
    if left <= allowed.share * beyond_poses(gap.before, before, allowed.poses):
        return 1.0
    spread = float(np.std(np.array(gap.draws.after) ** 2))
    return float(special.ndtr(-(left - target**2) / max(spread, 1e-12)))
