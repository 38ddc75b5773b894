"""Measures the gap before and after the named effects, with intervals.

The gap is the root mean square of held-out residuals in excess of the noise,

    G^2 = mean (measured - predicted)^2 - floor^2,

where a fit without a pose predicts it. `noise_floor` gives the floor. Intervals come from a
bootstrap over poses (`gap_resamples`).
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from torch import Tensor

from tofcorr.diagnosis.findings.coherence import Coherence, coherence
from tofcorr.diagnosis.findings.explained import Explained
from tofcorr.diagnosis.findings.gap_resamples import squared_gaps, squared_gaps_of
from tofcorr.diagnosis.findings.naming import NamedEffects
from tofcorr.diagnosis.findings.noise_floor import NoiseFloor, noise_floor
from tofcorr.diagnosis.findings.resamples import Interval, interval_of
from tofcorr.diagnosis.sums.blocks import solve
from tofcorr.diagnosis.sums.left_out import left_out_model
from tofcorr.diagnosis.sums.study import Study, residual_of


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
    explained: tuple[Explained, Sequence[Explained]] | None = None,
) -> Gap:
    """Measure the gap as given, after refitting, and after the named effects.

    Args:
        study: The recording, before any effect was named.
        named: The effects named.
        resamples: How often each resample holds each pose, shape (B, U).
        explained: Mean square of the simulator's residual, as given, that parameters and effects
            explain, and the same in every resample, m^2; None: no simulator was given. The gap as
            given is that and what they leave, so that no noise must be subtracted.
    """
    before = left_out_model(study, ()).mean_square()
    noise = gap_floor(study, named)
    floor = noise.size
    before, after = before - floor**2, _left_by(study, named) - floor**2
    draws = squared_gaps(study, named, noise, resamples)
    closed = _closed(before, after) if named.names else 0.0
    fractions = np.array([_closed(b, a) for b, a in draws]) if named.names else np.zeros(1)
    structure = coherence(study, residual_of(study, ()))
    components = _components(structure, max(before, 0.0))
    as_given, given_draws = None, []
    if explained is not None:
        as_given = _root(explained[0].with_left(after))
        pairs = zip(explained[1], draws, strict=True)
        given_draws = [_root(each.with_left(a)) for each, (_, a) in pairs]
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

    def computed() -> NoiseFloor:
        noise = noise_floor(named)
        return noise._replace(size=min(noise.size, float(np.sqrt(_left_by(study, named)))))

    return named.study.remembered("floor of the gap", computed)


def _left_by(study: Study, named: NamedEffects) -> float:
    """Return the mean square that the final model leaves held out, m^2."""
    if named.names or named.refined_terms:
        return left_out_model(named.study, named.columns).mean_square()
    return left_out_model(study, ()).mean_square()


def gap_steps(
    study: Study, named: NamedEffects, gap: Gap, resamples: Tensor
) -> list[tuple[str, float, Interval]]:
    """Return the gap after each named effect in turn and its 95 % interval, metres.

    Maps are subtracted in every step. Effects are not chosen anew in resamples.
    """
    steps = []
    base = float(left_out_model(study, ()).squares().sum())
    count = float(study.system.blocks.count.sum())
    for position, name in enumerate(named.names[:-1]):
        present = [n for n in named.names[: position + 1] if n in named.study.candidates.effects]
        model = left_out_model(named.study, present)
        size = _root(gap.before**2 - (base - float(model.squares().sum())) / count)
        squares = squared_gaps_of(study, model, gap.floor, resamples)
        draws = [_root(square) for square in squares.tolist()]
        steps.append((name, size, interval_of(draws, size)))
    if named.names:
        steps.append((named.names[-1], gap.after, gap.after_interval))
    return steps


def hand_eye_shift(study: Study, named: NamedEffects) -> tuple[float, float]:
    """Return how far the effects move the hand-eye transform, metres and radians."""
    count = study.fit.model.num_hand_eye
    if not count or not named.columns:
        return 0.0, 0.0
    without = solve(study.system.blocks.even, ())[:count]
    added = solve(named.study.system.blocks.even, named.columns)[:count]
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
