"""The gap before and after the effects: its size, its parts, and whether some of it is unknown.

Each pose is predicted by a fit to all others. To first order a sum of such squares varies only by
the poses that are drawn: the fit is where they are least. So nothing is fitted to a resample, whose
few different poses would predict far worse; but a model is drawn again, by its probability there.
Poses differ in their noise, which is subtracted as it is there. A pose that alone
shows a range of distances or angles is missed by any amount: the model is not wrong there, but
unknown.

What was shown to be smaller than half of the target gap is not unknown, however probable.
"""

from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
import torch
from scipy import special
from torch import Tensor

from tofcorr.diagnosis.findings.naming import NamedEffects
from tofcorr.diagnosis.findings.probability import Model
from tofcorr.diagnosis.findings.structure import (
    Coherence,
    NoiseFloor,
    coherence,
    noise_floor,
)
from tofcorr.diagnosis.findings.where import (
    Estimated,
    Stage,
    binned_covariates,
    find_where,
)
from tofcorr.diagnosis.sums.observations import hand_eye_columns
from tofcorr.diagnosis.sums.study import Study


def resampled(units: int, count: int, generator: torch.Generator) -> Tensor:
    """Draw how often each of some resamples holds each unit, shape (count, units)."""
    picked = torch.randint(0, units, (count, units), generator=generator)
    counts = torch.zeros(count, units, dtype=torch.float64)
    return counts.scatter_add(1, picked, torch.ones_like(counts))


def studentised(total: Tensor, count: Tensor, resamples: Tensor) -> Tensor:
    r"""Draw a ratio of sums over units from its studentised bootstrap (Efron and Tibshirani 1993).

    In a resample b the ratio differs from that of all units, r, by t_b standard errors of its own.
    The draws are

    .. math:: r - t_b \, \mathrm{se}(r) .

    With few units they reach farther than the ratios of the resamples, above all upwards, as they
    must: large squares are rare, and a sample without one seems more certain than it is. A resample
    of few poses that happen to be alike would seem to know everything: its standard error is a
    fifth of that of all units at least (chosen).

    Args:
        total: Numerator of every unit, shape (U,).
        count: Denominator of every unit, shape (U,).
        resamples: How often each resample holds each unit, shape (B, U).

    Returns:
        Shape (B,).
    """
    ratio, error = _ratio(total, count, torch.ones_like(resamples[:1]))
    own, own_error = _ratio(total, count, resamples)
    least = (error / 5).clamp(min=torch.finfo(total.dtype).tiny)
    return ratio - (own - ratio) * error / own_error.maximum(least)


def _ratio(total: Tensor, count: Tensor, weights: Tensor) -> tuple[Tensor, Tensor]:
    """Return ratios of weighted sums and their standard errors, shape (B,) each."""
    sums = (weights @ count).clamp(min=torch.finfo(total.dtype).tiny)
    ratio = (weights @ total) / sums
    deviations = total - ratio[:, None] * count
    freedom = len(total) / max(len(total) - 1, 1)
    return ratio, (freedom * (weights * deviations**2).sum(1)).sqrt() / sums


@dataclass(frozen=True, kw_only=True)
class Gap:
    """The gap before and after the effects, in metres.

    Attributes:
        before: With the base model refitted.
        after: With the named effects added.
        floor: Noise of a pixel, root mean square; at most what the effects leave.
        floor_from_repeats: Whether repeated frames gave the floor; else it is an upper bound.
        closed: 1 - after^2 / before^2.
        as_given: Of the simulator as given; None where none was given.
        structure: Of the residual of the base fit.
        between_images, fixed_pattern, within_images: Components of `before`; their squares add up.
        hand_eye_shift: How far the effects move the hand-eye transform, metres and radians.
    """

    before: Estimated
    after: Estimated
    floor: float
    floor_from_repeats: bool
    closed: Estimated
    as_given: Estimated | None
    structure: Coherence
    between_images: float
    fixed_pattern: float
    within_images: float
    hand_eye_shift: tuple[float, float]

    @property
    def whole(self) -> Estimated:
        """The gap to the simulator under diagnosis, or to the one fitted."""
        return self.before if self.as_given is None else self.as_given


def measure_gap(
    study: Study, named: NamedEffects, resamples: Tensor, explained: Tensor | None = None
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
    base = study.left_out_mean_square(())
    # A model that predicts worse than none would not be taken.
    left = base, min(base, named.study.left_out_mean_square(named.columns))
    noise = noise_floor(named)
    noise = noise._replace(size=min(noise.size, left[1] ** 0.5))
    squares = np.array(left)[None] - noise.size**2
    squares = np.concatenate([squares, squared_gaps(study, named, noise, resamples)])
    before, after = map(Estimated.of, np.sqrt(squares.clip(min=0)).T)
    closed = np.zeros(len(squares))
    if named.names:
        known = squares[:, 0] > 0
        ratio = squares[known, 1].clip(min=0) / squares[known, 0]
        closed[known] = (1 - ratio).clip(0, 1)
    as_given = None
    if explained is not None:
        own, least, most = explained.numpy().T
        given = np.minimum(np.maximum(own + squares[:, 1].clip(min=0), least), most.clip(min=0))
        as_given = Estimated.of(np.sqrt(given.clip(min=0)))
    structure = coherence(study, study.residual_of(()))
    between = float(np.clip(structure.between, 0.0, before**2))
    fixed = float(np.clip(structure.fixed, 0.0, before**2 - between))
    count = study.fit.model.num_hand_eye if named.columns else 0
    change = named.study.sums.ols.solve(named.columns)[:count] - study.sums.ols.solve(())[:count]
    return Gap(
        before=before,
        after=after,
        floor=noise.size,
        floor_from_repeats=study.fit.noise.repeats > 0,
        closed=Estimated.of(closed),
        as_given=as_given,
        structure=structure,
        between_images=between**0.5,
        fixed_pattern=fixed**0.5,
        within_images=max(before**2 - between - fixed, 0.0) ** 0.5,
        hand_eye_shift=(float(change[:3].norm()), float(change[3:].norm())),
    )


def squared_gaps(
    study: Study, named: NamedEffects, floor: NoiseFloor, resamples: Tensor
) -> np.ndarray:
    """Return squared gaps before and after the effects in every resample, (B, 2), m^2.

    The floor has one error for all squared gaps of a resample, and holds structure in half of them.
    No floor is below zero, so that no gap is larger than what is left.

    Args:
        study: The recording, before any effect was named.
        named: The effects named.
        floor: Noise that is no gap.
        resamples: How often each resample holds each pose, shape (B, U).
    """
    before = _squared_gap(study, study.left_out_squares(()), floor.size, resamples)
    after = before.clone()
    if named.names:
        for model, own in _drawn_again(named, resamples).items():
            # A map is taken where it is the one named; another one would have to be fitted again.
            held = study if named.maps.keys().isdisjoint(model) else named.study
            squares = held.left_out_squares(named.columns_of(model))
            after[own] = _squared_gap(study, squares, floor.size, resamples[own])
        after = torch.minimum(after, before)
    random, most = np.random.default_rng(study.options.seed), floor.size**2
    excess = floor.error * random.standard_normal(len(before))
    excess += min(floor.structure, most) * random.uniform(-1, 1, len(before)).clip(min=0)
    return torch.stack([before, after], dim=1).numpy() + np.minimum(excess, most)[:, None]


def _squared_gap(study: Study, squares: Tensor, floor: float, resamples: Tensor) -> Tensor:
    """Return the squared gap in every resample, with this floor, (B,), m^2.

    Args:
        study: The recording.
        squares: What a model leaves of each pose, shape (U,), m^2.
        floor: Noise that is no gap, metres; each pixel has its own share of it.
        resamples: How often each resample holds each pose, shape (B, U).
    """
    own = study.observations.per_pose(study.fit.share * study.fit.sigma**2)
    left = squares - (floor / study.fit.floor) ** 2 * own
    return studentised(left, study.sums.count, resamples)


def _drawn_again(named: NamedEffects, resamples: Tensor) -> dict[Model, Tensor]:
    """Draw a model for each resample, by the probabilities that its poses give; probes left out.

    Returns:
        The resamples of each model, shape (B,), bool.
    """
    generator = torch.Generator().manual_seed(named.study.options.seed + 5)
    probability = named.models.posterior(resamples, generator).T
    drawn = torch.multinomial(probability, 1, generator=generator)[:, 0]
    effects = named.models.effects
    own = [effects[number] for number in drawn.tolist()]
    return {model: torch.tensor([each == model for each in own]) for model in dict.fromkeys(own)}


def gap_steps(
    study: Study, named: NamedEffects, gap: Gap, resamples: Tensor
) -> list[tuple[str, Estimated]]:
    """Return the gap after each named effect in turn, metres.

    Maps are subtracted in every step. Effects are not chosen anew in resamples.
    """
    steps, count = [], float(study.sums.count.sum())
    base = float(study.left_out_squares(()).sum())
    for position, name in enumerate(named.names[:-1]):
        present = [n for n in named.names[: position + 1] if n in named.columns]
        squares = named.study.left_out_squares(present)
        size = max(gap.before**2 - (base - float(squares.sum())) / count, 0.0) ** 0.5
        gaps = _squared_gap(study, squares, gap.floor, resamples).clamp(min=0).sqrt()
        steps.append((name, Estimated(size, gaps.tolist())))
    return [*steps, (named.names[-1], gap.after)] if named.names else []


def stages_of(
    study: Study, named: NamedEffects, gap: Gap, residual: Tensor | None
) -> tuple[Stage, Stage, Stage]:
    """Return the three stages.

    Args:
        study: The recording, before any effect was named.
        named: The effects named.
        gap: Before and after them.
        residual: Of the simulator as given, shape (M,), metres; None: none was given.
    """
    binned, as_given = binned_covariates(study), Stage(name="as_given", gap=gap.as_given)
    if residual is not None:
        as_given = find_where(study, as_given, binned, None, residual)
    recalibrated = find_where(study, Stage(name="recalibrated", gap=gap.before), binned)
    with_effects = replace(recalibrated, name="with_effects", gap=gap.after)
    if named.names:
        with_effects = find_where(named.study, with_effects, binned, named.columns)
    return as_given, recalibrated, with_effects


@dataclass(frozen=True, kw_only=True)
class OpenSet:
    """What remains after the named effects.

    Class attributes:
        least_poses: With fewer poses nothing is called unknown. Two of the tests take standard
            errors over poses as known: of 60 recordings with four to seven poses and nothing
            missing seven would be.
        most_scatter: Scatter of poses that is no gap in itself, metres, and radians of their turn.
            A prior: robots repeat to 0.02 to 2 mm, and to as many mrad; a survey places a target to
            1 to 3 mm. What depends on anything recorded is no scatter.
        least_variance: Least variance that others are divided by, m^2: a micrometre squared.
            Chosen, below any noise.

    Attributes:
        unknown: Whether a gap remains that no effect explains.
        after: Structure of the residual with the named effects.
        fingerprint: What the remainder looks like: clauses that follow "It".
    """

    least_poses: ClassVar[int] = 8
    most_scatter: ClassVar[float] = 0.003
    least_variance: ClassVar[float] = 1e-12

    unknown: bool
    after: Coherence
    fingerprint: tuple[str, ...]

    @property
    def scatter(self) -> float:
        """Standard deviation of the poses by offset and tilts, over the image, metres."""
        return max(self.after.between, 0.0) ** 0.5


def judge_remainder(study: Study, named: NamedEffects, gap: Gap) -> OpenSet:
    """Judge whether something remains that no effect of the catalogue explains.

    It does where something in no catalogue is probable and may be larger than half of the target
    gap; where what remains is larger than poses and target together, and much of what there was;
    and where poses scatter by more than was stated.

    Args:
        study: The recording, before any effect was named.
        named: The effects named.
        gap: Before and after them.
    """
    options, tiny, poses = study.options, OpenSet.least_variance, study.sums.num_units
    theta = named.study.sums.ols.solve((*named.columns, *named.probes))
    known = len(named.study.sums.layout.of(named.columns))
    left = named.study.residual - named.study.times(named.columns, theta[:known])
    after = coherence(named.study, left)
    allowed, target = allowed_scatter(study, after), options.target_gap_mm / 1000

    def beyond_poses(size: float, structure: Coherence) -> float:
        """Return the square of a gap without the pose variance that is no gap, m^2."""
        return max(size**2 - float(np.clip(structure.between, 0.0, allowed)), 0.0)

    remains, most = (beyond_poses(own, after) for own in (gap.after, gap.after.interval[1]))
    # A hundredth of the level: with nothing missing it hardly ever rejects.
    spread = float(np.std(np.square(gap.after.draws)))
    chance = special.ndtr(-(remains - target**2) / max(spread, tiny))
    large = chance <= options.tests.level / 100
    share = remains / max(beyond_poses(gap.before, gap.structure), tiny)
    scattered = False
    if options.pose_repeatability_mm != "auto":
        chance = special.chdtrc(poses, poses * max(after.between, 0.0) / max(allowed, tiny))
        scattered = chance <= options.tests.level
    unknown = named.unknown > options.tests.named_from and most > (target / 2) ** 2
    unknown |= scattered or (large and share > options.unknown_share)
    enough = named.tested and poses >= OpenSet.least_poses
    return OpenSet(
        unknown=bool(unknown and enough),
        after=after,
        fingerprint=tuple(_fingerprint(named, left, after)),
    )


def allowed_scatter(study: Study, after: Coherence) -> float:
    """Return the variance of the poses that is no gap, m^2: stated, or what the data show.

    That is at most the variance of the distance by the largest usual errors of the poses.
    """
    if study.options.pose_repeatability_mm != "auto":
        return (study.options.pose_repeatability_mm / 1000) ** 2
    _, columns = hand_eye_columns(study.observations, study.fit.tool_from_camera)
    share = study.fit.share
    arm = float((share * columns[:, 3:].square().sum(1)).sum() / share.sum())
    return min(max(after.between, 0.0), OpenSet.most_scatter**2 * (1 + arm))


def _fingerprint(
    named: NamedEffects, left: Tensor, after: Coherence, *, mostly: float = 0.7
) -> list[str]:
    """Return what a residual (M,) looks like.

    Args:
        named: The effects named.
        left: The residual, shape (M,), metres.
        after: Its structure.
        mostly: Structure lies between images if they hold more than this share of it, and within
            images if these do. Chosen.
    """
    clauses = [named.study.probes[name].trace for name in named.probes]
    whole = max(after.within, 0.0) + max(after.between, 0.0)
    share = after.between / max(whole, OpenSet.least_variance)
    if share > mostly:
        clauses.append("shifts whole images")
    elif share < 1 - mostly and after.within > 0:
        form = "patches" if after.form == "squares" else after.form
        clauses.append(f"is similar within {form} of an image")
    lag = _lag_of_offsets(named.study, left)
    if lag is not None:
        clauses.append(f"correlates by {lag:+.2f} between successive images")
    return clauses


def _lag_of_offsets(study: Study, left: Tensor, *, level: float = 0.01) -> float | None:
    """Return the correlation of successive images' offsets, or None if it is not significant.

    With fewer than twelve frames it is not reported.

    Args:
        study: The recording.
        left: A residual, shape (M,), metres.
        level: Of significance. Chosen.
    """
    weight, frame, frames = study.weight, study.observations.frame, study.observations.num_frames
    count = torch.bincount(frame, weight, frames).clamp(min=OpenSet.least_variance)
    offsets = torch.bincount(frame, weight * left, frames) / count
    centred = offsets - offsets.mean()
    square = float(centred.square().sum())
    if frames < 12 or square == 0:
        return None
    lag = float(centred[1:] @ centred[:-1]) / square
    return lag if 2 * special.ndtr(-abs(lag) * frames**0.5) < level else None
