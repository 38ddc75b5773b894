"""Decides whether a gap remains that no effect of the catalogue explains, and describes it.

The tests behind `unknown` ask whether more remains than poses, noise and the target gap allow. Each
has a null hypothesis of its own; a weighted Bonferroni correction joins them. Four of them ask
whether anything remains. With nothing missing their p-values are uniform, and they have nearly all
of the level, so that the cause is then called unknown about as often as the level says. The others
ask whether more remains than matters.

What was shown to be smaller than half of the target gap is not unknown, however significant. Where
effects are named, neither is what was not shown to be larger than matters: the forms of effects are
never quite right.

Effects are named a second time where a gap is certain and no single effect was significant. With
few poses a test of twenty effects has little power: a cause must be far beyond what each of them
reaches by chance. That guards against a name where nothing is missing. The tests behind `unknown`
ask the same of the recording as a whole, at the same level. Where they find that something is
missing, nothing is left to guard against, and an effect need be significant by itself only (a
gatekeeping procedure; Dmitrienko, Offen and Westfall 2003).
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import torch
from scipy import special
from torch import Tensor

from tofcorr.diagnosis.findings.effect_comparison import NORMAL_95, closed_square, held_out_squares
from tofcorr.diagnosis.findings.gap import Gap, measure_gap
from tofcorr.diagnosis.findings.naming import NamedEffects, name_effects
from tofcorr.diagnosis.findings.structure import Coherence, Waves, coherence, unlike_waves
from tofcorr.diagnosis.findings.where import Region, Where, find_where
from tofcorr.diagnosis.sums.observations import hand_eye_columns
from tofcorr.diagnosis.sums.study import Study

# The right causes leave little structure inside images: at most a third of what there was before,
# and this size, m^2. Chosen. Half of the target gap is enough where effects are named, and for a
# bias along a covariate: a part of the gap matters from half of it on.
_MISFIT_SIZE = 0.0003**2
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
    target = allowed.target * (0.5 if named.names else 1.0)
    p_values = {
        "structure": _within(named, before, after, target),
        "poses": _poses(named, after, target, allowed),
        "size": _size_test(gap, before, after, target, allowed),
    }
    most = beyond_poses(gap.after_interval[1], after, allowed.poses)
    if most <= (0.5 * allowed.target) ** 2:
        return p_values | dict.fromkeys(("probes", "effects", "waves", "covariates"), 1.0)
    least = allowed.target * (0.5 if named.names else 0.0)
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
    if named.names or beyond_poses(gap.after, after, allowed.poses) <= (0.5 * allowed.target) ** 2:
        return 1.0
    least = (named.study.options.tests.material_mm / 1000) ** 2
    tests = named.last.tests.values()
    large = [test.name for test in tests if closed_square(named.study, test) >= least]
    return min((named.last.naming_p_value(name) for name in large), default=1.0)


def _within(named: NamedEffects, before: Coherence, after: Coherence, target: float) -> float:
    """Structure within images is larger than what matters, or than right causes leave."""
    least = _least_within(named, before, target)
    return float(special.ndtr(-(after.within - least) / max(after.within_error, _LEAST_VARIANCE)))


def _least_within(named: NamedEffects, before: Coherence, target: float) -> float:
    """Return the square of the structure within images that matters, m^2."""
    if not named.names:
        return target**2
    return min(target**2, max(before.within / 3, _MISFIT_SIZE))


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
    poses = named.study.sums.num_units
    return float(
        special.chdtrc(poses, poses * max(after.between, 0.0) / max(least, _LEAST_VARIANCE))
    )


def _size_test(
    gap: Gap, before: Coherence, after: Coherence, target: float, allowed: Allowed
) -> float:
    """More remains than the target and the poses together, and much of what there was (normal)."""
    left = beyond_poses(gap.after, after, allowed.poses)
    if left <= allowed.share * beyond_poses(gap.before, before, allowed.poses):
        return 1.0
    spread = float(np.std(np.array(gap.draws.after) ** 2))
    return float(special.ndtr(-(left - target**2) / max(spread, _LEAST_VARIANCE)))


# Least variance that others are divided by, m^2: a micrometre squared. Chosen, below any noise.
_LEAST_VARIANCE = 1e-12
# Structure counts if it exceeds its standard error by this factor. The usual convention.
_SIGNIFICANT = 3.0
# Scatter of poses that is no gap in itself, metres, and radians of their turn. A prior: robots
# repeat to 0.02 to 2 mm, and to as many mrad; a survey places a target to 1 to 3 mm. What depends
# on anything recorded is no scatter.
_MOST_SCATTER = 0.003
# Structure lies between images if they hold more than this share of it, and within images if these
# do. Chosen.
_MOSTLY = 0.7
# A correlation between successive frames is reported from this number of frames on, and below this
# p-value. Chosen.
_LEAST_FRAMES = 12
_CORRELATION_LEVEL = 0.01
# With fewer poses nothing is called unknown. Two of the tests take standard errors over poses as
# known: of 60 recordings with four to seven poses and nothing missing seven would be.
_LEAST_POSES = 8


@dataclass(frozen=True, kw_only=True)
class OpenSet:
    """What remains after the named effects.

    Attributes:
        unknown: Whether a gap remains that no effect explains.
        score: How large and how unexplained the remainder is, from 0 to 1, for ranking.
        before: Structure of the residual of the base fit.
        after: Structure of the residual with the named effects.
        remaining_share: Squared structure after over before.
        fingerprint: What the remainder looks like: clauses that follow "It".
        scatter: Standard deviation of the poses by offset and tilts, over the image, metres.
        p_value: Probability of such a remainder if none is larger than what does not matter.
        p_values: Of each test of `unknown_tests` by itself.
    """

    unknown: bool
    score: float
    before: Coherence
    after: Coherence
    remaining_share: float
    scatter: float
    fingerprint: tuple[str, ...]
    p_value: float
    p_values: Mapping[str, float]


def judge_remainder(
    study: Study,
    named: NamedEffects,
    gap: Gap,
    where: Where | None = None,
    *,
    half_size: float = 0.0007,
) -> OpenSet:
    """Test whether more remains than poses, noise and the target gap allow.

    Args:
        study: The recording, before any effect was named.
        named: The effects named.
        gap: Before and after them.
        where: Bias of what they leave along all covariates; None: it is computed.
        half_size: Size of an unknown gap at which the score is a half, metres. Chosen.
    """
    options = study.options
    before = gap.structure
    left = remainder(named)
    after = coherence(named.study, left)
    allowed = _allowed(study, after)
    size_before, size_after = _size(before, allowed.poses), _size(after, allowed.poses)
    share = float(np.clip(size_after / max(size_before, _LEAST_VARIANCE), 0.0, 1.0))
    score = share * size_after / (size_after + half_size**2)
    probed, probed_share = _closed_by_probes(study, named)
    score = max(score, probed_share * probed / (probed + half_size**2))
    where = find_where(named.study, named.columns) if where is None else where
    p_values = unknown_p_values(named, gap, (before, after), where, allowed)
    p_value = joined(p_values)
    return OpenSet(
        unknown=_enough_poses(named) and p_value <= options.tests.level,
        score=float(score),
        before=before,
        after=after,
        remaining_share=share,
        scatter=float(max(after.between, 0.0)) ** 0.5,
        fingerprint=tuple(_fingerprint(named, left, after)),
        p_value=p_value,
        p_values=p_values,
    )


def _enough_poses(named: NamedEffects) -> bool:
    """Return whether the tests of what remains can be trusted."""
    return named.tested and named.study.sums.num_units >= _LEAST_POSES


def _allowed(study: Study, after: Coherence) -> Allowed:
    """Return what may remain; the scatter of the poses is estimated unless a user states it."""
    options = study.options
    stated, estimated = options.pose_repeatability_mm, max(after.between, 0.0)
    if estimated > _MOST_SCATTER**2:
        estimated = min(estimated, _most_scatter(study))
    return Allowed(
        target=options.target_gap_mm / 1000,
        poses=estimated if stated == "auto" else (stated / 1000) ** 2,
        poses_given=stated != "auto",
        share=options.unknown_share,
    )


def _most_scatter(study: Study) -> float:
    """Return the variance of the distance by the largest usual errors of the poses, m^2."""
    _, columns = hand_eye_columns(study.observations, study.fit.tool_from_camera)
    share = study.fit.share
    arm = float((share * columns[:, 3:].square().sum(1)).sum() / share.sum())
    return _MOST_SCATTER**2 * (1 + arm)


def remainder(named: NamedEffects) -> Tensor:
    """Return the residual of the final model without its probes, shape (M,), metres."""
    study = named.study
    theta = study.sums.ols.solve(named.model)
    known = len(study.sums.layout.of(named.columns))
    return study.system.residual - study.system.times(named.columns, theta[:known])


def _closed_by_probes(study: Study, named: NamedEffects) -> tuple[float, float]:
    """Return what the probes of the model close, m^2, and as a share of the whole gap."""
    if not named.probes:
        return 0.0, 0.0
    without, probed, before = (
        float(held_out_squares(own, names).sum() / study.sums.count.sum())
        for own, names in ((named.study, named.columns), (named.study, named.model), (study, ()))
    )
    gap = max(before - study.fit.floor**2, before - probed, _LEAST_VARIANCE)
    closed = max(without - probed, 0.0)
    return closed, float(np.clip(closed / gap, 0.0, 1.0))


def _size(structure: Coherence, allowed: float) -> float:
    """Return the variance of significant structure beyond the repeatability of poses, m^2."""
    within = structure.within if structure.within > _SIGNIFICANT * structure.within_error else 0.0
    return max(within, 0.0) + max(structure.between - allowed, 0.0)


def _fingerprint(named: NamedEffects, left: Tensor, after: Coherence) -> list[str]:
    study = named.study
    clauses = [study.candidates.probes[name].trace for name in named.probes]
    share = after.between / max(after.total, _LEAST_VARIANCE)
    if share > _MOSTLY:
        clauses.append("shifts whole images")
    elif share < 1 - _MOSTLY and after.within > 0:
        form = {"squares": "patches", "rows": "rows", "columns": "columns"}[after.form]
        clauses.append(f"is similar within {form} of an image")
    lag = _lag_of_offsets(study, left)
    if lag is not None:
        clauses.append(f"correlates by {lag:+.2f} between successive images")
    return clauses


def _lag_of_offsets(study: Study, left: Tensor) -> float | None:
    """Return the correlation of successive images' offsets, or None if it is not significant."""
    frames = study.observations.num_frames
    weight, frame = study.weight, study.observations.frame
    total = torch.zeros(frames, dtype=torch.float64).index_add(0, frame, weight * left)
    count = torch.zeros(frames, dtype=torch.float64).index_add(0, frame, weight)
    offsets = (total / count.clamp(min=_LEAST_VARIANCE)).numpy()
    if frames < _LEAST_FRAMES or np.std(offsets) == 0:
        return None
    centred = offsets - offsets.mean()
    lag = float((centred[1:] * centred[:-1]).sum() / (centred**2).sum())
    significant = 2 * special.ndtr(-abs(lag) * np.sqrt(frames)) < _CORRELATION_LEVEL
    return lag if significant else None


def name_in_two(study: Study, resamples: Tensor) -> NamedEffects:
    """Name effects; where none is and a gap is certain, name the one that explains most of it.

    Args:
        study: The recording.
        resamples: How often each resample holds each pose, shape (B, U); for the gap.
    """
    named = name_effects(study)
    if named.names or not named.likeliest:
        return named
    remainder = judge_remainder(study, named, measure_gap(study, named, resamples))
    return name_effects(study, certain=True) if remainder.unknown else named
