"""Whether a gap remains that no effect of the catalogue explains, and what it looks like."""

from dataclasses import dataclass

import numpy as np
import torch
from scipy import stats
from torch import Tensor

from tofcorr.diagnosis.findings.coherence import Coherence, coherence
from tofcorr.diagnosis.findings.how_far import Gap
from tofcorr.diagnosis.findings.select import Selection
from tofcorr.diagnosis.sums.blocks import solve
from tofcorr.diagnosis.sums.crossval import held_out_squares
from tofcorr.diagnosis.sums.study import Study

# Structure must exceed its own standard error by so much to count.
_SIGNIFICANT = 3.0
# Structure inside images that a cause of the right form does not leave: so clear, so much of what
# there was, and larger than this, m^2.
_MISFIT_CLEAR = 4.0
_MISFIT_SHARE = 1 / 3
_MISFIT_SIZE = 0.0003**2
# An unknown gap of this size, metres, is as likely to matter as not: scale of the score.
_HALF_SIZE = 0.0007


@dataclass(frozen=True, kw_only=True)
class OpenSet:
    """The verdict on what remains.

    Attributes:
        unknown: Whether a gap remains that no effect explains.
        score: The same as a number from 0 to 1, for ranking.
        before: Structure of the base fit's residual.
        after: Structure that the named effects leave.
        remaining_share: Squared structure after over before.
        fingerprint: What the remainder looks like, clauses to go on after "It".
    """

    unknown: bool
    score: float
    before: Coherence
    after: Coherence
    remaining_share: float
    fingerprint: tuple[str, ...]


def judge_remainder(study: Study, selection: Selection, gap: Gap) -> OpenSet:
    """Compare gap and structure of the residual before and after the named effects."""
    options = study.options
    before = gap.structure
    left = remainder(selection)
    after = coherence(selection.study, left)
    allowed = (options.pose_repeatability_mm * 1e-3) ** 2
    size_before, size_after = _size(before, allowed), _size(after, allowed)
    share = float(np.clip(size_after / max(size_before, 1e-12), 0.0, 1.0))
    score = share * size_after / (size_after + _HALF_SIZE**2)
    marked, marked_share = _closed_by_marks(study, selection)
    score = max(score, marked_share * marked / (marked + _HALF_SIZE**2))
    target = options.target_gap_mm * 1e-3
    structured = size_after > target**2 and share > options.unknown_share
    # A cause of the right form leaves poses to scatter as the robot lets them.
    scattered = bool(selection.named) and after.between > allowed
    # What poses may scatter is no gap.
    open_before = _beyond_poses(gap.before, before, allowed)
    open_after = _beyond_poses(gap.after, after, allowed)
    stays = (
        open_after > (target / 2 if selection.named else target) ** 2
        and open_after > options.unknown_share * open_before
        and gap.after_interval[0] > 0
    )
    unnamed = not selection.named and open_after > (target / 2) ** 2 and _still_noticed(selection)
    unexplained = (
        structured
        or scattered
        or stays
        or unnamed
        or _misfits(selection, before, after)
        or bool(selection.unexplained)
    )
    return OpenSet(
        unknown=selection.tested and unexplained,
        score=float(score),
        before=before,
        after=after,
        remaining_share=share,
        fingerprint=tuple(_fingerprint(selection, left, after)),
    )


def _beyond_poses(size: float, structure: Coherence, allowed: float) -> float:
    """Return the square of a gap without what poses may scatter, m^2."""
    return max(size**2 - float(np.clip(structure.between, 0.0, allowed)), 0.0)


def _still_noticed(selection: Selection) -> bool:
    """Return whether some effect would gain significantly, though none is worth a name."""
    last, level = selection.last, selection.study.options.tests.level
    return any(last.family_p_value(name) <= level for name in last.tests)


def _misfits(selection: Selection, before: Coherence, after: Coherence) -> bool:
    """Return whether effects leave more inside images than causes of the right form would."""
    least = max(_MISFIT_CLEAR * after.within_error, _MISFIT_SHARE * before.within, _MISFIT_SIZE)
    return bool(selection.named) and after.within > least


def remainder(selection: Selection) -> Tensor:
    """Return the residual of the final model, marks of unknown effects put back, (M,), metres."""
    study = selection.study
    members = study.blocks.layout.of(selection.model)
    theta = solve(study.blocks.even, selection.model)
    known = len(study.blocks.layout.of(selection.columns))
    return study.residual - study.columns[:, members[:known]] @ theta[:known]


def _closed_by_marks(study: Study, selection: Selection) -> tuple[float, float]:
    """Return what marks of unknown effects close, m^2, and as a share of the whole gap."""
    if not selection.unexplained:
        return 0.0, 0.0
    blocks, folds = selection.study.blocks, study.folds
    count = float(blocks.count.sum())
    named = float(held_out_squares(blocks, selection.columns, folds).sum()) / count
    marked = float(held_out_squares(blocks, selection.model, folds).sum()) / count
    before = float(held_out_squares(study.blocks, (), folds).sum()) / count
    gap = max(before - study.fit.floor**2, before - marked, 1e-12)
    closed = max(named - marked, 0.0)
    return closed, float(np.clip(closed / gap, 0.0, 1.0))


def _size(structure: Coherence, allowed: float) -> float:
    """Return the squared structure that counts: significant, beyond what poses may scatter."""
    within = structure.within if structure.within > _SIGNIFICANT * structure.within_error else 0.0
    return max(within, 0.0) + max(structure.between - allowed, 0.0)


def _fingerprint(selection: Selection, left: Tensor, after: Coherence) -> list[str]:
    study = selection.study
    marks = [study.probes[name].trace for name in selection.unexplained]
    share = after.between / max(after.total, 1e-12)
    if share > 0.7:
        marks.append("shifts whole images")
    elif share < 0.3 and after.within > 0:
        form = {"squares": "patches", "rows": "rows", "columns": "columns"}[after.form]
        marks.append(f"is alike within {form} of an image")
    marks += _series(study, left)
    return marks


def _series(study: Study, left: Tensor) -> list[str]:
    """Return what the offsets of frames in their order look like."""
    frames = study.observations.num_frames
    weight, frame = study.weight, study.observations.frame
    total = torch.zeros(frames, dtype=torch.float64).index_add(0, frame, weight * left)
    count = torch.zeros(frames, dtype=torch.float64).index_add(0, frame, weight)
    offsets = (total / count.clamp(min=1e-30)).numpy()
    if frames < 12 or np.std(offsets) == 0:
        return []
    centred = offsets - offsets.mean()
    lag = float((centred[1:] * centred[:-1]).sum() / (centred**2).sum())
    if 2 * stats.norm.sf(abs(lag) * np.sqrt(frames)) < 0.01:
        return [f"shifts from frame to frame with correlation {lag:+.2f}"]
    return []
