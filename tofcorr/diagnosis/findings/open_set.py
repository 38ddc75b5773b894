"""Decides whether a gap remains that no effect of the catalogue explains, and describes it."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import torch
from scipy import special
from torch import Tensor

from tofcorr.diagnosis.findings.coherence import Coherence, coherence
from tofcorr.diagnosis.findings.how_far import Gap
from tofcorr.diagnosis.findings.naming import NamedEffects
from tofcorr.diagnosis.findings.unknown_tests import Allowed, joined, unknown_p_values
from tofcorr.diagnosis.findings.where import Where, find_where
from tofcorr.diagnosis.sums.additions import HeldOutSquares
from tofcorr.diagnosis.sums.blocks import solve
from tofcorr.diagnosis.sums.prediction import hand_eye_columns
from tofcorr.diagnosis.sums.study import Study

# Structure counts if it exceeds its standard error by this factor. The usual convention.
_SIGNIFICANT = 3.0
# Scatter of poses that is no gap in itself, metres. A prior: robots repeat to 0.02 to 2 mm, and a
# survey places a target to 1 to 3 mm. What depends on anything recorded is no scatter.
_MOST_SCATTER = 0.003
# Turn of poses that is no gap in itself, radians. A prior: robots repeat to as many mrad as mm.
_MOST_TURN = 0.003
# Size of an unknown gap at which the score is a half, metres. Chosen.
_HALF_SIZE = 0.0007
# Structure lies between images if they hold more than the first share of it, and within images if
# they hold less than the second. Chosen.
_MOSTLY_BETWEEN, _MOSTLY_WITHIN = 0.7, 0.3
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
    study: Study, named: NamedEffects, gap: Gap, where: Where | None = None
) -> OpenSet:
    """Test whether more remains than poses, noise and the target gap allow.

    Args:
        study: The recording, before any effect was named.
        named: The effects named.
        gap: Before and after them.
        where: Bias of what they leave along all covariates; None: it is computed.
    """
    options = study.options
    before = gap.structure
    left = remainder(named)
    after = coherence(named.study, left)
    allowed = _allowed(study, after)
    size_before, size_after = _size(before, allowed.poses), _size(after, allowed.poses)
    share = float(np.clip(size_after / max(size_before, 1e-12), 0.0, 1.0))
    score = share * size_after / (size_after + _HALF_SIZE**2)
    probed, probed_share = _closed_by_probes(study, named)
    score = max(score, probed_share * probed / (probed + _HALF_SIZE**2))
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
    return named.tested and named.study.system.blocks.num_units >= _LEAST_POSES


def _allowed(study: Study, after: Coherence) -> Allowed:
    """Return what may remain; the scatter of the poses is estimated unless a user states it."""
    options = study.options
    stated, estimated = options.pose_repeatability_mm, max(after.between, 0.0)
    if estimated > _MOST_SCATTER**2:
        estimated = min(estimated, _most_scatter(study))
    return Allowed(
        target=options.target_gap_mm * 1e-3,
        poses=estimated if stated == "auto" else (stated * 1e-3) ** 2,
        poses_given=stated != "auto",
        share=options.unknown_share,
    )


def _most_scatter(study: Study) -> float:
    """Return the variance of the distance by the largest usual errors of the poses, m^2."""
    _, columns = hand_eye_columns(study.observations, study.fit.tool_from_camera)
    share = study.fit.share
    arm = float((share * columns[:, 3:].square().sum(1)).sum() / share.sum())
    return _MOST_SCATTER**2 + _MOST_TURN**2 * arm


def remainder(named: NamedEffects) -> Tensor:
    """Return the residual of the final model without its probes, shape (M,), metres."""
    study = named.study
    theta = solve(study.system.blocks.even, named.model)
    known = len(study.system.blocks.layout.of(named.columns))
    return study.system.residual - study.system.columns.times(named.columns, theta[:known])


def _closed_by_probes(study: Study, named: NamedEffects) -> tuple[float, float]:
    """Return what the probes of the model close, m^2, and as a share of the whole gap."""
    if not named.probes:
        return 0.0, 0.0
    blocks, folds = named.study.system.blocks, study.resampling.folds
    count = float(blocks.count.sum())
    without = float(HeldOutSquares(blocks, named.columns, folds).squares.sum()) / count
    probed = float(HeldOutSquares(blocks, named.model, folds).squares.sum()) / count
    before = float(HeldOutSquares(study.system.blocks, (), folds).squares.sum()) / count
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
    offsets = (total / count.clamp(min=1e-30)).numpy()
    if frames < _LEAST_FRAMES or np.std(offsets) == 0:
        return None
    centred = offsets - offsets.mean()
    lag = float((centred[1:] * centred[:-1]).sum() / (centred**2).sum())
    significant = 2 * special.ndtr(-abs(lag) * np.sqrt(frames)) < _CORRELATION_LEVEL
    return lag if significant else None
