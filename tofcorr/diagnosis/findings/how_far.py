"""How large the gap is, what closes it, and how sure that is.

The gap is the root mean square of held-out residuals over the noise,

    G^2 = mean (measured - predicted)^2 - floor^2,

every pose predicted by a fit without it. Repeats know the floor to some per cent only, of which a
small gap consists; within these it is what the best model leaves less what pixels, images and
poses share of that, for noise is shared by none. Intervals come from resampling the poses; each
resample refits base model, hand-eye and effects, and chooses the effects again.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from tofcorr.diagnosis.findings.coherence import Coherence, coherence
from tofcorr.diagnosis.findings.select import Selection
from tofcorr.diagnosis.findings.which import compare
from tofcorr.diagnosis.sums.blocks import solve
from tofcorr.diagnosis.sums.prediction import predicted_distance
from tofcorr.diagnosis.sums.study import Study

Interval = tuple[float, float]
_LEVEL = 0.95
# The floor of repeats, or of neighbouring pixels, is known to this share.
_FLOOR_ERROR = 0.05


@dataclass(frozen=True, kw_only=True)
class Gap:
    """The gap before and after the effects, in metres, with 95 % intervals.

    Attributes:
        before, before_interval: Base model refitted.
        after, after_interval: With the effects named.
        floor: Noise, no more than the effects leave.
        floor_from_repeats: Whether repeated frames gave it; else it is an upper bound.
        closed: 1 - after^2 / before^2, and its interval.
        as_given: With the parameters as given.
        structure: Of the base fit's residual.
        between_images, fixed_pattern, within_images: Parts of `before`, added in squares.
        hand_eye_shift: How far the effects move the hand-eye transform, metres and radians.
        fractions: Closed fractions of the resamples, for plots, shape (B,).
    """

    before: float
    before_interval: Interval
    after: float
    after_interval: Interval
    floor: float
    floor_from_repeats: bool
    closed: float
    closed_interval: Interval
    as_given: float
    structure: Coherence
    between_images: float
    fixed_pattern: float
    within_images: float
    hand_eye_shift: tuple[float, float]
    fractions: np.ndarray


def measure_gap(
    study: Study, selection: Selection, generator: torch.Generator, as_given: Tensor | None = None
) -> Gap:
    """Measure the gap before and after the selected effects.

    Args:
        study: The recording, before any map was taken off.
        selection: What was named.
        generator: Of the bootstrap.
        as_given: Residual to the simulator as given, shape (M,), metres; None: to the recording's
            own guess of the hand-eye transform, without an error model.
    """
    units = study.blocks.num_units
    ones = torch.ones(units, dtype=torch.float64)
    before = after = _mean_square(study, (), ones)
    if selection.named or selection.taken_up:
        after = _mean_square(selection.study, selection.columns, ones)
    floor = min(_floor(selection), float(np.sqrt(after)))
    before, after = before - floor**2, after - floor**2
    draws = _resampled(study, selection, floor, generator)
    closed = _closed(before, after) if selection.named else 0.0
    fractions = np.array([_closed(b, a) for b, a in draws]) if selection.named else np.zeros(1)
    structure = coherence(study, study.residual_of(()))
    parts = _parts(structure, max(before, 0.0))
    return Gap(
        before=_root(before),
        before_interval=_interval([_root(b) for b, _ in draws], _root(before)),
        after=_root(after),
        after_interval=_interval([_root(a) for _, a in draws], _root(after)),
        floor=floor,
        floor_from_repeats=study.fit.noise.repeats > 0,
        closed=closed,
        closed_interval=_interval(list(fractions), closed),
        as_given=_as_given(study, floor, as_given),
        structure=structure,
        between_images=parts[0],
        fixed_pattern=parts[1],
        within_images=parts[2],
        hand_eye_shift=hand_eye_shift(study, selection),
        fractions=fractions,
    )


def _floor(selection: Selection) -> float:
    """Return the noise: what the final model leaves that nothing shares, near the floor known."""
    study = selection.study
    share, left = study.fit.share, study.residual_of(selection.columns)
    structure = coherence(study, left)
    inside = max(structure.within, structure.fixed, 0.0)
    square = float((share * left**2).sum() / share.sum()) - inside - max(structure.between, 0.0)
    known = study.fit.floor
    return float(np.clip(_root(square), (1 - _FLOOR_ERROR) * known, (1 + _FLOOR_ERROR) * known))


def hand_eye_shift(study: Study, selection: Selection) -> tuple[float, float]:
    """Return how far the effects move the hand-eye transform, metres and radians."""
    count = study.fit.model.num_hand_eye
    if not count or not selection.columns:
        return 0.0, 0.0
    without = solve(study.blocks.even, ())[:count]
    added = solve(selection.study.blocks.even, selection.columns)[:count]
    change = added - without
    return float(change[:3].norm()), float(change[3:].norm())


def _mean_square(study: Study, names: Sequence[str], weights: Tensor) -> float:
    squares = study.left_out_squares(names, weights)
    return float((weights * squares).sum() / (weights * study.blocks.count).sum())


def _resampled(
    study: Study, selection: Selection, floor: float, generator: torch.Generator
) -> list[tuple[float, float]]:
    """Return squared gaps before and after in every resample of the poses."""
    units = study.blocks.num_units
    rivals = _rivals(selection)
    draws = []
    for _ in range(study.options.bootstraps):
        picked = torch.randint(0, units, (units,), generator=generator)
        weights = torch.bincount(picked, minlength=units).double()
        before = after = _mean_square(study, (), weights)
        if selection.named or selection.taken_up:
            names = _chosen_again(selection, rivals, weights)
            after = _mean_square(selection.study, names, weights)
        draws.append((before - floor**2, after - floor**2))
    return draws


def _rivals(selection: Selection) -> dict[str, dict[str, Tensor]]:
    """Return for every named effect what it and its aliases close in its place, (U,) each."""
    rivals = {}
    for name, members in zip(selection.named, selection.sets, strict=True):
        if name not in selection.study.effects:
            continue
        others = [n for n in selection.columns if n != name]
        tests = compare(selection.study, others, flips=False, maps=False).tests
        rivals[name] = {n: test.closed for n, test in tests.items() if n in members}
    return rivals


def _chosen_again(
    selection: Selection, rivals: dict[str, dict[str, Tensor]], weights: Tensor
) -> list[str]:
    """Choose in the place of each named effect what closes most on the resampled poses."""
    chosen = [n for n in selection.taken_up if n in selection.study.effects]
    for gains in rivals.values():
        free = {n: float((weights * g).sum()) for n, g in gains.items() if n not in chosen}
        chosen.append(max(free, key=lambda n: free[n]))
    return chosen


def _closed(before: float, after: float) -> float:
    if before <= 0:
        return 0.0
    return float(np.clip(1.0 - max(after, 0.0) / before, 0.0, 1.0))


def _root(square: float) -> float:
    return float(np.sqrt(max(square, 0.0)))


def _interval(draws: list[float], estimate: float) -> Interval:
    """Return the percentile interval, widened to hold the estimate."""
    low, high = np.quantile(draws, [(1 - _LEVEL) / 2, (1 + _LEVEL) / 2])
    return min(float(low), estimate), max(float(high), estimate)


def _as_given(study: Study, floor: float, residual: Tensor | None) -> float:
    """Return the gap of parameters that nobody fitted, metres."""
    if residual is None:
        observations = study.observations
        guess = torch.from_numpy(observations.recording.tool_from_camera)
        residual = observations.measured - predicted_distance(observations, guess)
    share = study.fit.share * residual.isfinite()
    mean = float((share * residual.nan_to_num(0.0) ** 2).sum() / share.sum())
    return _root(mean - floor**2)


def _parts(structure: Coherence, before: float) -> tuple[float, float, float]:
    """Split the squared gap into between images, fixed pattern and the rest; return roots."""
    between = float(np.clip(structure.between, 0.0, before))
    fixed = float(np.clip(structure.fixed, 0.0, before - between))
    return _root(between), _root(fixed), _root(before - between - fixed)
