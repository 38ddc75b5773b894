"""Decides whether a gap remains that no effect of the catalogue explains, and describes it."""

from dataclasses import dataclass

import numpy as np
import torch
from scipy import special
from torch import Tensor

from tofcorr.diagnosis.findings.coherence import Coherence, coherence
from tofcorr.diagnosis.findings.how_far import Gap
from tofcorr.diagnosis.findings.naming import NamedEffects
from tofcorr.diagnosis.sums.blocks import solve
from tofcorr.diagnosis.sums.crossval import held_out_squares
from tofcorr.diagnosis.sums.study import Study

# Structure counts if it exceeds its standard error by this factor. The usual convention.
_SIGNIFICANT = 3.0
# The right causes leave little structure inside images. More counts as a misfit if it exceeds its
# standard error by this factor, this share of what there was before, and this size, m^2. Chosen.
_MISFIT_SIGNIFICANT = 4.0
_MISFIT_SHARE = 1 / 3
_MISFIT_SIZE = 0.0003**2
# Size of an unknown gap at which the score is a half, metres. Chosen.
_HALF_SIZE = 0.0007
# Structure lies between images if they hold more than the first share of it, and within images if
# they hold less than the second. Chosen.
_MOSTLY_BETWEEN, _MOSTLY_WITHIN = 0.7, 0.3
# A correlation between successive frames is reported from this number of frames on, and below this
# p-value. Chosen.
_LEAST_FRAMES = 12
_CORRELATION_LEVEL = 0.01


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
        p_value: Probability of such a remainder if none is larger than what does not matter.
    """

    unknown: bool
    score: float
    before: Coherence
    after: Coherence
    remaining_share: float
    fingerprint: tuple[str, ...]
    p_value: float


def judge_remainder(study: Study, named: NamedEffects, gap: Gap) -> OpenSet:
    """Compare gap and structure of the residual before and after the named effects."""
    options = study.options
    before = gap.structure
    left = remainder(named)
    after = coherence(named.study, left)
    allowed = (options.pose_repeatability_mm * 1e-3) ** 2
    size_before, size_after = _size(before, allowed), _size(after, allowed)
    share = float(np.clip(size_after / max(size_before, 1e-12), 0.0, 1.0))
    score = share * size_after / (size_after + _HALF_SIZE**2)
    probed, probed_share = _closed_by_probes(study, named)
    score = max(score, probed_share * probed / (probed + _HALF_SIZE**2))
    target = options.target_gap_mm * 1e-3
    structured = size_after > target**2 and share > options.unknown_share
    # With the right causes poses vary no more than the robot repeats.
    poses_vary = bool(named.names) and after.between > allowed
    # Pose scatter within repeatability is not counted.
    open_before = _beyond_poses(gap.before, before, allowed)
    open_after = _beyond_poses(gap.after, after, allowed)
    stays = (
        open_after > (target / 2 if named.names else target) ** 2
        and open_after > options.unknown_share * open_before
        and gap.after_interval[0] > 0
    )
    unnamed = not named.names and open_after > (target / 2) ** 2 and _still_significant(named)
    unexplained = (
        structured
        or poses_vary
        or stays
        or unnamed
        or _misfits(named, before, after)
        or bool(named.probes)
    )
    return OpenSet(
        unknown=named.tested and unexplained,
        score=float(score),
        before=before,
        after=after,
        remaining_share=share,
        fingerprint=tuple(_fingerprint(named, left, after)),
        p_value=_p_value(named, gap, after, target / 2 if named.names else target, allowed),
    )


def _p_value(
    named: NamedEffects, gap: Gap, after: Coherence, target: float, allowed: float
) -> float:
    """Return the smallest of four p-values times four (Bonferroni).

    Each belongs to one null hypothesis: structure within images is at most the target (normal), the
    scatter of the poses at most the repeatability (chi-squared), the gap that remains at most the
    target and the repeatability together (bootstrap), and no probe belongs to the model.

    Args:
        named: The effects named.
        gap: Before and after them.
        after: Structure of what they leave.
        target: Size of a gap that does not matter, metres.
        allowed: Variance of the poses that does not matter, m^2.
    """
    poses = named.study.system.blocks.num_units
    within = special.ndtr(-(after.within - target**2) / max(after.within_error, 1e-12))
    scatter = special.chdtrc(poses, poses * max(after.between, 0.0) / allowed)
    least = target**2 + min(max(after.between, 0.0), allowed)
    draws = np.array(gap.draws.after) ** 2
    stays = (1 + (draws <= least).sum()) / (1 + len(draws))
    probed = [named.probe_p_values[name] for name in named.probes]
    return float(min(1.0, 4 * min([float(within), float(scatter), float(stays), *probed])))


def _beyond_poses(size: float, structure: Coherence, allowed: float) -> float:
    """Return the square of a gap without the pose variance that repeatability allows, m^2."""
    return max(size**2 - float(np.clip(structure.between, 0.0, allowed)), 0.0)


def _still_significant(named: NamedEffects) -> bool:
    """Return whether some effect is still significant, though too small to report."""
    last, level = named.last, named.study.options.tests.level
    return any(last.family_p_value(name) <= level for name in last.tests)


def _misfits(named: NamedEffects, before: Coherence, after: Coherence) -> bool:
    """Return whether effects leave more inside images than the right causes would."""
    least = max(
        _MISFIT_SIGNIFICANT * after.within_error, _MISFIT_SHARE * before.within, _MISFIT_SIZE
    )
    return bool(named.names) and after.within > least


def remainder(named: NamedEffects) -> Tensor:
    """Return the residual of the final model without its probes, shape (M,), metres."""
    study = named.study
    members = study.system.blocks.layout.of(named.model)
    theta = solve(study.system.blocks.even, named.model)
    known = len(study.system.blocks.layout.of(named.columns))
    return study.system.residual - study.system.columns[:, members[:known]] @ theta[:known]


def _closed_by_probes(study: Study, named: NamedEffects) -> tuple[float, float]:
    """Return what the probes of the model close, m^2, and as a share of the whole gap."""
    if not named.probes:
        return 0.0, 0.0
    blocks, folds = named.study.system.blocks, study.resampling.folds
    count = float(blocks.count.sum())
    without = float(held_out_squares(blocks, named.columns, folds).sum()) / count
    probed = float(held_out_squares(blocks, named.model, folds).sum()) / count
    before = float(held_out_squares(study.system.blocks, (), folds).sum()) / count
    gap = max(before - study.fit.floor**2, before - probed, 1e-12)
    closed = max(without - probed, 0.0)
    return closed, float(np.clip(closed / gap, 0.0, 1.0))


def _size(structure: Coherence, allowed: float) -> float:
    """Return the variance of significant structure beyond the repeatability of poses, m^2."""
    within = structure.within if structure.within > _SIGNIFICANT * structure.within_error else 0.0
    return max(within, 0.0) + max(structure.between - allowed, 0.0)


def _fingerprint(named: NamedEffects, left: Tensor, after: Coherence) -> list[str]:
    study = named.study
    clauses = [study.candidates.probes[name].trace for name in named.probes]
    share = after.between / max(after.total, 1e-12)
    if share > _MOSTLY_BETWEEN:
        clauses.append("shifts whole images")
    elif share < _MOSTLY_WITHIN and after.within > 0:
        form = {"squares": "patches", "rows": "rows", "columns": "columns"}[after.form]
        clauses.append(f"is similar within {form} of an image")
    clauses += _series(study, left)
    return clauses


def _series(study: Study, left: Tensor) -> list[str]:
    """Describe the correlation of successive frames' offsets, if it is significant."""
    frames = study.observations.num_frames
    weight, frame = study.weight, study.observations.frame
    total = torch.zeros(frames, dtype=torch.float64).index_add(0, frame, weight * left)
    count = torch.zeros(frames, dtype=torch.float64).index_add(0, frame, weight)
    offsets = (total / count.clamp(min=1e-30)).numpy()
    if frames < _LEAST_FRAMES or np.std(offsets) == 0:
        return []
    centred = offsets - offsets.mean()
    lag = float((centred[1:] * centred[:-1]).sum() / (centred**2).sum())
    if 2 * special.ndtr(-abs(lag) * np.sqrt(frames)) < _CORRELATION_LEVEL:
        return [f"shifts whole frames; successive frames correlate by {lag:+.2f}"]
    return []
