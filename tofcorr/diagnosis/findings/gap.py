"""The gap before and after the effects: its size, its parts, and the resamples of its intervals.

Each pose is predicted by a fit to all others. To first order a sum of such squares varies only by
the poses that are drawn: the fit is where they are least. So nothing is fitted to a resample, whose
few different poses would predict far worse; but the effects are selected again, or none where none
is large enough. Poses differ in their noise, which is subtracted as it is there. A pose that alone
shows a range of distances or angles is missed by any amount: the model is not wrong there, but
unknown.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from tofcorr.diagnosis.findings.effect_comparison import compare_effects
from tofcorr.diagnosis.findings.naming import NamedEffects
from tofcorr.diagnosis.findings.structure import (
    Coherence,
    NoiseFloor,
    coherence,
    noise_floor,
    noise_of_poses,
)
from tofcorr.diagnosis.sums.study import Study

Interval = tuple[float, float]
TWO_SIDED = 1.96
"""Standard deviations of a normal distribution on either side that hold 95 %. A mathematical
constant."""


def draw_resamples(study: Study, generator: torch.Generator) -> Tensor:
    """Draw how often each resample holds each pose, shape (B, U)."""
    return resampled(study.sums.num_units, study.options.bootstraps, generator)


def resampled(units: int, count: int, generator: torch.Generator) -> Tensor:
    """Draw how often each of some resamples holds each unit, shape (count, units)."""
    picked = [torch.randint(0, units, (units,), generator=generator) for _ in range(count)]
    return torch.stack([torch.bincount(own, minlength=units) for own in picked]).double()


def studentised(
    total: Tensor, count: Tensor, resamples: Tensor, *, least_error: float = 0.2
) -> Tensor:
    r"""Draw a ratio of sums over units from its studentised bootstrap (Efron and Tibshirani 1993).

    In a resample b the ratio differs from that of all units, r, by t_b standard errors of its own.
    The draws are

    .. math:: r - t_b \, \mathrm{se}(r) .

    With few units they reach farther than the ratios of the resamples, above all upwards, as they
    must: large squares are rare, and a sample without one seems more certain than it is.

    Args:
        total: Numerator of every unit, shape (U,).
        count: Denominator of every unit, shape (U,).
        resamples: How often each resample holds each unit, shape (B, U).
        least_error: Least standard error in a resample over that of all units, no unit. Chosen: a
            resample of few poses that happen to be alike would otherwise seem to know everything.

    Returns:
        Shape (B,).
    """
    whole = torch.ones_like(resamples[:1])
    ratio, error = _ratio(total, count, whole)
    own, own_error = _ratio(total, count, resamples)
    least = (least_error * error).clamp(min=torch.finfo(total.dtype).tiny)
    return ratio - (own - ratio) * error / own_error.maximum(least)


def _ratio(total: Tensor, count: Tensor, weights: Tensor) -> tuple[Tensor, Tensor]:
    """Return ratios of weighted sums and their standard errors, shape (B,) each."""
    sums = (weights @ count).clamp(min=torch.finfo(total.dtype).tiny)
    ratio = (weights @ total) / sums
    deviations = total - ratio[:, None] * count
    freedom = len(total) / max(len(total) - 1, 1)
    return ratio, (freedom * (weights * deviations**2).sum(1)).sqrt() / sums


def interval_of(draws: Sequence[float], estimate: float, *, level: float = 0.95) -> Interval:
    """Return the percentile interval, widened to contain the estimate.

    Args:
        draws: Of a quantity.
        estimate: Of the same quantity.
        level: Coverage of all intervals. The usual convention.
    """
    low, high = np.quantile(list(draws), [(1 - level) / 2, (1 + level) / 2])
    return min(float(low), estimate), max(float(high), estimate)


def hull(intervals: Iterable[Interval]) -> Interval:
    """Return the least interval that contains all."""
    lows, highs = zip(*intervals, strict=True)
    return min(lows), max(highs)


def squared_gaps(
    study: Study, named: NamedEffects, floor: NoiseFloor, resamples: Tensor
) -> list[tuple[float, float]]:
    """Return squared gaps before and after the effects in every resample, m^2.

    The floor has one error for all squared gaps of a resample, and holds structure in half of them.
    No floor is below zero, so that no gap is larger than what is left.

    Args:
        study: The recording, before any effect was named.
        named: The effects named.
        floor: Noise that is no gap.
        resamples: How often each resample holds each pose, shape (B, U).
    """
    draws = _resampled(study, named, floor.size, resamples)
    random, most = np.random.default_rng(study.options.seed), floor.size**2
    excess = floor.error * random.standard_normal(len(draws))
    excess += min(floor.structure, most) * random.uniform(-1, 1, len(draws)).clip(min=0)
    draws = draws + np.minimum(excess, most)[:, None]
    return [(before, after) for before, after in draws.tolist()]


def squared_gaps_of(study: Study, squares: Tensor, floor: float, resamples: Tensor) -> Tensor:
    """Return the squared gap in every resample, with this floor, (B,), m^2.

    Args:
        study: The recording.
        squares: What a model leaves of each pose, shape (U,), m^2.
        floor: Noise that is no gap, metres.
        resamples: How often each resample holds each pose, shape (B, U).
    """
    return studentised(squares - noise_of_poses(study, floor), study.sums.count, resamples)


def _resampled(study: Study, named: NamedEffects, floor: float, resamples: Tensor) -> np.ndarray:
    """Return squared gaps before and after in every resample, (B, 2), m^2."""
    before = squared_gaps_of(study, study.left_out_squares(()), floor, resamples)
    after = before.clone()
    if named.names or named.refined_terms:
        rivals = _rivals(named)
        chosen = [_chosen_again(named, rivals, weights) for weights in resamples]
        for names in dict.fromkeys(chosen):
            own = torch.tensor([each == names for each in chosen])
            squares = named.study.left_out_squares(names)
            after[own] = squared_gaps_of(study, squares, floor, resamples[own])
    return torch.stack([before, after], dim=1).numpy()


def _rivals(named: NamedEffects) -> dict[str, dict[str, Tensor]]:
    """Return what each named effect and its cause set close in its place, (U,) each."""
    rivals = {}
    for name, members in zip(named.names, named.cause_sets, strict=True):
        if name not in named.study.candidates.effects:
            continue
        others = [n for n in named.columns if n != name]
        tests = compare_effects(named.study, others, flips=False, maps=False).tests
        rivals[name] = {n: test.closed for n, test in tests.items() if n in members}
    return rivals


def _chosen_again(
    named: NamedEffects, rivals: dict[str, dict[str, Tensor]], weights: Tensor
) -> tuple[str, ...]:
    """Select for each named effect the member of its cause set that closes most in a resample.

    None is selected where none closes what an effect must close to be named.
    """
    chosen = [n for n in named.refined_terms if n in named.study.candidates.effects]
    tests, count = named.study.options.tests, named.study.sums.count
    size = tests.material_mm if len(named.names) == 1 else tests.further_mm
    least = (size / 1000) ** 2 * float(weights @ count)
    for gains in rivals.values():
        left = {n: float((weights * g).sum()) for n, g in gains.items() if n not in chosen}
        best = max(left, key=lambda n: left[n])
        if left[best] >= least:
            chosen.append(best)
    return tuple(chosen)


@dataclass(frozen=True, kw_only=True)
class GapDraws:
    """The gap in every resample of the poses, metres.

    Attributes:
        as_given: Of the simulator as given; empty where none was given.
        before, after: Without and with the named effects.
    """

    as_given: tuple[float, ...]
    before: tuple[float, ...]
    after: tuple[float, ...]


@dataclass(frozen=True, kw_only=True)
class Gap:
    """The gap before and after the effects, in metres, with 95 % intervals.

    Attributes:
        before, before_interval: With the base model refitted.
        after, after_interval: With the named effects added.
        floor: Noise of a pixel, root mean square; at most what the effects leave.
        floor_from_repeats: Whether repeated frames gave the floor; else it is an upper bound.
        closed, closed_interval: 1 - after^2 / before^2.
        as_given, as_given_interval: Of the simulator as given; None where none was given.
        structure: Of the residual of the base fit.
        between_images, fixed_pattern, within_images: Components of `before`; their squares add up.
        hand_eye_shift: How far the effects move the hand-eye transform, metres and radians.
        draws: What the intervals come from.
    """

    before: float
    before_interval: Interval
    after: float
    after_interval: Interval
    floor: float
    floor_from_repeats: bool
    closed: float
    closed_interval: Interval
    as_given: float | None
    as_given_interval: Interval | None
    structure: Coherence
    between_images: float
    fixed_pattern: float
    within_images: float
    hand_eye_shift: tuple[float, float]
    draws: GapDraws


def measure_gap(
    study: Study,
    named: NamedEffects,
    resamples: Tensor,
    explained: Tensor | None = None,
) -> Gap:
    """Measure the gap as given, after refitting, and after the named effects.

    Args:
        study: The recording, before any effect was named.
        named: The effects named.
        resamples: How often each resample holds each pose, shape (B, U).
        explained: What parameters and effects explain of the simulator's residual, as in
            `explained_squares`, of all poses and then of every resample, (1 + B, 3), m^2; None: no
            simulator was given. The gap as given is that and what they leave, so that no noise must
            be subtracted.
    """
    before = study.left_out_mean_square(())
    noise = gap_floor(study, named)
    floor = noise.size
    before, after = before - floor**2, _left_by(study, named) - floor**2
    draws = squared_gaps(study, named, noise, resamples)
    closed = _closed(before, after) if named.names else 0.0
    fractions = np.array([_closed(b, a) for b, a in draws]) if named.names else np.zeros(1)
    structure = coherence(study, study.system.residual_of(()))
    components = _components(structure, max(before, 0.0))
    as_given, given_draws = None, []
    if explained is not None:
        left = torch.tensor([after, *(a for _, a in draws)], dtype=torch.float64).clamp(min=0)
        own, least, most = explained.T
        squares = torch.minimum(torch.maximum(own + left, least), most.clamp(min=0))
        as_given, *given_draws = map(_root, squares.tolist())
    return Gap(
        before=_root(before),
        before_interval=interval_of([_root(b) for b, _ in draws], _root(before)),
        after=_root(after),
        after_interval=interval_of([_root(a) for _, a in draws], _root(after)),
        floor=floor,
        floor_from_repeats=study.fit.noise.repeats > 0,
        closed=closed,
        closed_interval=interval_of(list(fractions), closed),
        as_given=as_given,
        as_given_interval=None if as_given is None else interval_of(given_draws, as_given),
        structure=structure,
        between_images=components[0],
        fixed_pattern=components[1],
        within_images=components[2],
        hand_eye_shift=hand_eye_shift(study, named),
        draws=GapDraws(
            as_given=tuple(given_draws),
            before=tuple(_root(b) for b, _ in draws),
            after=tuple(_root(a) for _, a in draws),
        ),
    )


def gap_floor(study: Study, named: NamedEffects) -> NoiseFloor:
    """Return the noise that the gap is in excess of; it is at most what the final model leaves."""
    noise = noise_floor(named)
    return noise._replace(size=min(noise.size, float(np.sqrt(_left_by(study, named)))))


def _left_by(study: Study, named: NamedEffects) -> float:
    """Return the mean square that the final model leaves held out, m^2."""
    if named.names or named.refined_terms:
        return named.study.left_out_mean_square(named.columns)
    return study.left_out_mean_square(())


def gap_steps(
    study: Study, named: NamedEffects, gap: Gap, resamples: Tensor
) -> list[tuple[str, float, Interval]]:
    """Return the gap after each named effect in turn and its 95 % interval, metres.

    Maps are subtracted in every step. Effects are not chosen anew in resamples.
    """
    steps = []
    base = float(study.left_out_squares(()).sum())
    count = float(study.sums.count.sum())
    for position, name in enumerate(named.names[:-1]):
        present = [n for n in named.names[: position + 1] if n in named.study.candidates.effects]
        squares = named.study.left_out_squares(present)
        size = _root(gap.before**2 - (base - float(squares.sum())) / count)
        gaps = squared_gaps_of(study, squares, gap.floor, resamples)
        draws = [_root(square) for square in gaps.tolist()]
        steps.append((name, size, interval_of(draws, size)))
    if named.names:
        steps.append((named.names[-1], gap.after, gap.after_interval))
    return steps


def hand_eye_shift(study: Study, named: NamedEffects) -> tuple[float, float]:
    """Return how far the effects move the hand-eye transform, metres and radians."""
    count = study.fit.model.num_hand_eye
    if not count or not named.columns:
        return 0.0, 0.0
    without = study.sums.ols.solve(())[:count]
    added = named.study.sums.ols.solve(named.columns)[:count]
    change = added - without
    return float(change[:3].norm()), float(change[3:].norm())


def _closed(before: float, after: float) -> float:
    if before <= 0:
        return 0.0
    return float(np.clip(1.0 - max(after, 0.0) / before, 0.0, 1.0))


def _root(square: float) -> float:
    return float(np.sqrt(max(square, 0.0)))


def _components(structure: Coherence, before: float) -> tuple[float, float, float]:
    """Split the squared gap: between images, fixed pattern, within images; return the roots."""
    between = float(np.clip(structure.between, 0.0, before))
    fixed = float(np.clip(structure.fixed, 0.0, before - between))
    return _root(between), _root(fixed), _root(before - between - fixed)


class LonePoses(NamedTuple):
    """Poses that no other pose predicts.

    Attributes:
        frames: The first frame of each.
        distance: Nearest and farthest distance that they show, metres.
        share: What they make of the squared gap.
        others: The gap of all other poses, metres.
    """

    frames: tuple[int, ...]
    distance: tuple[float, float]
    share: float
    others: float


def lone_poses(
    study: Study, floor: float, *, alone_limit: float = 8.0, most: float = 0.5
) -> LonePoses | None:
    """Return the poses that make most of the base model's gap because they are alone, or None.

    Args:
        study: The recording, before any effect was named.
        floor: Noise of a pixel that is no gap, metres.
        alone_limit: A pose is alone if a fit to all others misses it by so many times the mean
            square that the fit to all poses leaves in it. Chosen: with 20 poses that are alike the
            ratio is below 3.
        most: Share of the squared gap, at least, that such poses make where they are worth a line.
            Chosen.
    """
    square, count = study.left_out_squares(()), study.sums.count
    alone = square > alone_limit * _left_by_all(study)
    gap = float(square.sum() - floor**2 * count.sum())
    share = float(square[alone].sum() - floor**2 * count[alone].sum()) / gap if gap > 0 else 0.0
    if not share > most or bool(alone.all()):
        return None
    mean = float(square[~alone].sum() / count[~alone].sum())
    distance = study.inputs.radial_distance[alone[study.unit_of_pixel]]
    unit = study.observations.unit
    return LonePoses(
        frames=tuple(int((unit == pose).nonzero()[0]) for pose in alone.nonzero()[:, 0].tolist()),
        distance=(float(distance.min()), float(distance.max())),
        share=min(share, 1.0),
        others=max(mean - floor**2, 0.0) ** 0.5,
    )


def _left_by_all(study: Study) -> Tensor:
    """Return the ordinary sum of squares that the fit to all poses leaves in each, (U,), m^2."""
    ols = study.sums.ols
    return ols.squares_at((), ols.solve(()).expand(study.sums.num_units, -1))
