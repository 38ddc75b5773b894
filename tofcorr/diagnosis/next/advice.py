"""What to record next, so that more can be concluded, and what would have been found."""

from collections import Counter
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from tofcorr.diagnosis.findings.absorption import absorbed_share, left_over, remainder
from tofcorr.diagnosis.findings.effect_comparison import NORMAL_95, EffectTest
from tofcorr.diagnosis.findings.naming import NamedEffects
from tofcorr.diagnosis.sums.linear_system import BASE, PoseSums, pose_columns, pose_sums
from tofcorr.diagnosis.sums.noise import brightness_of
from tofcorr.diagnosis.sums.observations import Observations, effect_inputs, predicted_distance
from tofcorr.diagnosis.sums.study import Study
from tofcorr.geometry import se3
from tofcorr.simulation.effects import CATALOGUE
from tofcorr.simulation.effects.inputs import FrameFacts, is_clock

# Recorded frames that candidates are made from, and pixels of each that are used. Chosen for speed.
_SOURCES, _PIXELS = 12, 150
# Change of tilt of a candidate, radians: 20 degrees.
_TILT = 0.35
# Pixels with a smaller cosine of incidence, or nearer than this, metres, are not used: 73 degrees,
# and nearer than time-of-flight cameras measure.
_LEAST_COSINE = 0.3
_LEAST_DISTANCE = 0.1


@dataclass(frozen=True, kw_only=True)
class Candidates:
    """Frames that could be recorded.

    Attributes:
        words: How each differs from its source, C of them.
        source: The recorded frame that each is made from.
        sums: Over their pixels, each candidate one unit, poses as uncertain as the recorded.
    """

    words: list[str]
    source: list[int]
    sums: PoseSums


Change = Callable[[FrameFacts, Tensor], FrameFacts]


def make_candidates(study: Study, names: Collection[str]) -> Candidates | None:
    """Vary pose and conditions of some recorded frames, one at a time.

    Args:
        study: The recording.
        names: Effects whose columns are needed; the sums hold no others.

    Returns:
        None for a recording that states nothing which could be varied: neither poses of a moving
        tool, nor a clock, nor other conditions.
    """
    observations = study.observations
    frames = observations.num_frames
    sources = torch.linspace(0, frames - 1, min(_SOURCES, frames)).round().long().unique()
    changes = _changes(study)
    if not changes:
        return None
    known = {name: v[sources] for name, v in vars(observations.facts).items() if v is not None}
    made = [change(replace(observations.facts, **known), sources) for change in changes.values()]
    joined = {name: torch.cat([getattr(each, name) for each in made]) for name in known}
    source = sources.repeat(len(changes))
    words = [label for label in changes for _ in sources]
    shown = _observations(study, replace(made[0], **joined), source)
    return Candidates(words=words, source=source.tolist(), sums=_sums(study, shown, names))


def _changes(study: Study) -> dict[str, Change]:
    """Return the possible changes, by their description."""
    facts = study.observations.facts
    changes: dict[str, Change] = {}
    if is_clock(facts.timestamp):
        later = 1.02 * float(facts.timestamp.max()) + 60.0
        changes["in the first minute after power-on"] = lambda f, _: _timed(f, 1.0)
        changes["after all others"] = lambda f, _: _timed(f, later)
    if facts.integration_time is not None:
        changes["with half the integration time"] = _linear("integration_time", 0.5)
        changes["with twice the integration time"] = _linear("integration_time", 2.0)
    if facts.room_temperature is not None:
        changes["with the room 4 degrees warmer"] = _linear("room_temperature", 1.0, 4.0)
        changes["with the room 4 degrees colder"] = _linear("room_temperature", 1.0, -4.0)
    if facts.ambient is not None:
        strong = 2.0 * float(facts.ambient.nan_to_num(0.0).max()) + 100.0
        changes["with a lamp on"] = _linear("ambient", 1.0, strong)
        changes["in the dark"] = _linear("ambient", 0.0)
    if study.observations.recording.moves:
        for axis, name in ((0, "up or down"), (1, "to the side")):
            for angle in (_TILT, -_TILT):
                degrees = 20 if angle > 0 else -20
                changes[f"tilted {name} by {degrees:+.0f} degrees"] = _moved(
                    study, 1.0, axis, angle
                )
        changes["from 30 % nearer"] = _moved(study, 0.7)
        changes["from 30 % farther"] = _moved(study, 1.3)
    return changes


def _timed(facts: FrameFacts, time: float) -> FrameFacts:
    spread = torch.arange(len(facts.timestamp), dtype=torch.float64)
    return replace(facts, timestamp=time + spread)


def _linear(name: str, factor: float, amount: float = 0.0) -> Change:
    return lambda facts, _: replace(facts, **{name: factor * getattr(facts, name) + amount})


def _moved(study: Study, factor: float, axis: int = 0, angle: float = 0.0) -> Change:
    """Turn the camera about the point where its axis meets the target, and move it along the axis.

    Args:
        study: The recording.
        factor: Of the distance from that point.
        axis: Of the camera that it is turned about.
        angle: Radians.
    """
    pose, frame = study.fit.tool_from_camera, study.observations.frame
    total = torch.zeros(study.observations.num_frames, dtype=torch.float64)
    count = torch.bincount(frame, minlength=len(total)).clamp(min=1)
    distance = total.index_add(0, frame, study.inputs.radial_distance) / count
    turn = torch.zeros(6, dtype=torch.float64)
    turn[3 + axis] = angle

    def change(facts: FrameFacts, sources: Tensor) -> FrameFacts:
        there = torch.eye(4, dtype=torch.float64).repeat(2, len(sources), 1, 1)
        there[0, :, 2, 3] = distance[sources]
        there[1, :, 2, 3] = factor * distance[sources]
        turned = there[0] @ se3.exp(turn) @ se3.inverse(there[1])
        camera = pose @ turned @ se3.inverse(pose)
        return replace(facts, world_from_tool=facts.world_from_tool @ camera)

    return change


def _observations(study: Study, facts: FrameFacts, source: Tensor) -> Observations:
    """Return the pixels of the candidates, with amplitudes scaled from their sources."""
    old = study.observations
    ends = old.frame_ends
    frames, places = [], []
    for number, (start, end) in enumerate(ends[frame] for frame in source.tolist()):
        places.append(torch.arange(start, end, max(1, (end - start) // _PIXELS)))
        frames.append(torch.full_like(places[-1], number))
    place = torch.cat(places)
    images = old.amplitude_images
    made = replace(
        old,
        facts=facts,
        frame=torch.cat(frames),
        pixel=old.pixel[place],
        measured=old.measured[place],
        amplitude=None if old.amplitude is None else old.amplitude[place],
        amplitude_images=None if images is None else images[source],
        distance_images=old.distance_images[source],
        on_target=torch.ones_like(old.on_target[source]),
        unit=torch.arange(len(source)),
        wall=None if old.wall is None else old.wall[source],
    )
    distance = predicted_distance(made, study.fit.tool_from_camera)
    before = study.inputs.radial_distance[place]
    usable = (distance > _LEAST_DISTANCE) & distance.isfinite() & (distance < 3 * before)
    distance = torch.where(usable, distance, before)
    amplitude, new = made.amplitude, facts.integration_time
    if amplitude is not None:
        amplitude = amplitude * (before / distance) ** 2
        if old.facts.integration_time is not None and new is not None:
            exposure = (new / old.facts.integration_time[source])[made.frame]
            amplitude = amplitude * exposure.nan_to_num(1.0)
    return replace(made, measured=distance, amplitude=amplitude)


def _sums(study: Study, made: Observations, names: Collection[str]) -> PoseSums:
    pose = study.fit.tool_from_camera
    inputs = effect_inputs(made, pose)
    seen = (inputs.radial_distance > _LEAST_DISTANCE) & (inputs.incidence_cosine > _LEAST_COSINE)
    base = study.fit.model.on(made).columns(pose)
    # What is uncertain of the simulator's own error, or of the amplitude, is not computed anew.
    rest = base.new_zeros(len(base), study.sums.layout.base - base.shape[1])
    effects = {name: study.candidates.effects[name] for name in names}
    columns = {BASE: torch.cat([base, rest], dim=1)}
    columns |= {name: each.columns(inputs) * each.prior_sd() for name, each in effects.items()}
    for part in columns.values():
        seen &= part.isfinite().all(dim=1)
    first = torch.zeros_like(made.frame)
    sigma = study.fit.noise.at(brightness_of(made), first)
    # The few pixels get the weight of all pixels that a frame of the recording has.
    full = len(study.observations.measured) / study.observations.num_frames
    stand_for = full / max(len(made.measured) / made.num_frames, 1.0)
    zero, layout = torch.zeros_like(sigma), study.sums.layout
    fit = replace(study.fit, residual=zero, sigma=sigma, trust=seen.double() * stand_for)
    sums = pose_sums(
        made,
        {name: torch.where(seen[:, None], own, 0.0) for name, own in columns.items()},
        torch.where(seen[:, None], pose_columns(inputs).nan_to_num(0.0), 0.0),
        zero,
        fit,
        layout.prior[: layout.base, : layout.base],
    )
    return replace(sums, pose_sd=study.sums.pose_sd, dispersion=study.sums.dispersion)


# Standard normal quantile of 80 % power. The usual choice in the design of experiments.
_POWER_QUANTILE = 0.8416
# Shares that calibration absorbs: above the first another recording is needed; above the second an
# effect is not identifiable, for the rest is rounding error. Chosen.
_MOSTLY_ABSORBED, _NOT_IDENTIFIABLE = 0.97, 0.999


def minimum_detectable(study: Study, named: NamedEffects, seed: int) -> dict[str, float | None]:
    """Return the size of each effect that would be found with 80 % probability, metres.

    The size is the root mean square of the effect's signal over all pixels, before base model and
    hand-eye transform absorb their share. None: the effect is not identifiable, because they absorb
    all of it.

    Args:
        study: The recording.
        named: The effects named.
        seed: Of the random directions.
    """
    generator = torch.Generator().manual_seed(seed)
    critical = named.first.critical_score(0.05)
    return {
        name: _of_columns(study, test, critical, generator)
        if name in study.candidates.effects
        else _of_map(study, test, critical)
        for name, test in named.first.tests.items()
    }


def noncentrality(test: EffectTest, critical: float) -> float:
    """Return the noncentrality that lifts the gain above its critical value in 80 % of cases."""
    middle, high = _middle_and_high(test)
    threshold = middle + critical * (high - middle) / NORMAL_95
    level = max(threshold - middle, 1.0)
    return (_POWER_QUANTILE + float(np.sqrt(_POWER_QUANTILE**2 + level))) ** 2


def _middle_and_high(test: EffectTest) -> tuple[float, float]:
    """Return the median and the 95 % quantile of a test's null distribution."""
    middle, high = torch.quantile(test.null, test.null.new_tensor([0.5, 0.95])).tolist()
    return middle, high


def _of_columns(
    study: Study, test: EffectTest, critical: float, generator: torch.Generator
) -> float | None:
    gls, ols = study.sums.gls, study.sums.ols
    if absorbed_share(study, test.name) > _NOT_IDENTIFIABLE:
        return None
    low, high = ols.layout.effects[test.name]
    members = torch.arange(study.fit.model.num_columns)
    prior = ols.layout.prior_of(members)
    seen = left_over(gls.total, members, low, high, prior)
    plain = ols.total / (ols.scale * study.sums.count.sum())
    raw = plain[low:high, low:high]
    # So that the base model's system can be solved: four digits above the rounding of float64.
    ridge = 1e-12 * torch.eye(len(members), dtype=torch.float64)
    left = left_over(plain, members, low, high, ridge)
    # Of random directions in the space of the coefficients the median is reported.
    directions = torch.randn(64, high - low, generator=generator, dtype=torch.float64)
    signal, size, remains = (
        torch.einsum("di,ij,dj->d", directions, matrix, directions).clamp(min=1e-30)
        for matrix in (seen, raw, left)
    )
    detectable = (size / signal * noncentrality(test, critical)).sqrt()
    tests = study.options.tests
    least = tests.form_tolerance_mm if CATALOGUE[test.name].refines else study.material_mm
    reportable = (size / remains).sqrt() * least * 1e-3
    return float(torch.maximum(detectable, reportable).median())


def _of_map(study: Study, test: EffectTest, critical: float) -> float:
    """Return the size of a map of independent values that would be found, metres."""
    precision = float(study.weight.sum())
    middle, high = _middle_and_high(test)
    threshold = critical * (high - middle) / NORMAL_95 + (high - middle)
    detectable = np.sqrt(max(threshold, 1.0) / precision)
    return float(max(detectable, study.material_mm * 1e-3))


# Frames that are advised for one question, and questions that are answered. Chosen: what a person
# records in one go.
_FRAMES_ADVISED, _MOST_QUESTIONS = 8, 3

Question = tuple[str, tuple[str, ...]]
"""An effect to identify, and those to distinguish it from, besides the calibration."""


def next_recording(study: Study, named: NamedEffects) -> list[str]:
    """Return what to record next, the most useful first, in sentences.

    First which frames would distinguish the effects of a cause set, or show an effect that the
    calibration absorbs; then the inputs of effects that could not be tested.
    """
    asked = _questions(study, named)
    advice: list[str] = []
    if asked:
        candidates = make_candidates(
            study, {name for one, others in asked for name in (one, *others)}
        )
        for effect, others in asked:
            goal = f"To observe {effect}, which calibration absorbs"
            if others:
                goal = f"To distinguish {effect} from {' and '.join(others)}"
            how = ":"
            if candidates is not None:
                how = _advised(study, named, candidates, effect, others) + " In general:"
            advice.append(f"{goal}{how} {CATALOGUE[effect].remedy}.")
    advice += [
        f"{name} could not be tested: it needs {', '.join(wants)}. Best: {CATALOGUE[name].remedy}."
        for name, wants in study.candidates.missing.items()
    ]
    return advice


def _questions(study: Study, named: NamedEffects) -> list[Question]:
    """Return the cause sets to be separated, then the effects that calibration absorbs."""
    asked: list[Question] = []
    for members in named.cause_sets:
        known = [name for name in members if name in study.candidates.effects]
        if len(known) > 1 and len(known) == len(members):
            asked.append((known[0], tuple(known[1:])))
    asked += [
        (name, ())
        for name in study.candidates.effects
        if absorbed_share(study, name) > _MOSTLY_ABSORBED and name not in named.names
    ]
    return asked[:_MOST_QUESTIONS]


def _advised(
    study: Study,
    named: NamedEffects,
    candidates: Candidates,
    effect: str,
    others: tuple[str, ...],
) -> str:
    """Choose the most informative frames for one question, one after another; describe them."""
    names, layout = [*others, effect], study.sums.layout
    members, own = layout.of(others), layout.of(names)
    prior = layout.prior_of(members)
    total, frames = study.sums.gls.total[own][:, own], candidates.sums.gls.of(names)[0]
    size = len(total) - len(members)

    def information(gram: Tensor) -> Tensor:
        """Return the information on the effect, per coefficient, given calibration and others."""
        left = remainder(gram, len(members), prior)
        return left.diagonal(dim1=-2, dim2=-1).sum(-1) / size

    before = float(information(total))
    picked: list[int] = []
    for _ in range(_FRAMES_ADVISED):
        gains = information(total + frames)
        gains[picked] = -torch.inf
        picked.append(int(gains.argmax()))
        total = total + frames[picked[-1]]
    after = float(information(total))
    test = named.first.tests[effect]
    now = _detectable_size(study, test, named.first.critical_score(0.05), before)
    then = now * float(np.sqrt(max(before, 1e-30) / max(after, 1e-30)))
    gain = "It could then be detected"
    if np.isfinite(now):
        gain += f" from {1e3 * then:.1f} mm on, instead of {1e3 * now:.1f} mm"
    listed = _listed(candidates, picked)
    return f", record {_FRAMES_ADVISED} more frames: {listed}. {gain}."


def _listed(candidates: Candidates, picked: Sequence[int]) -> str:
    counted = Counter(candidates.words[number] for number in picked)
    parts = []
    for words, count in counted.most_common():
        sources = {candidates.source[n] for n in picked if candidates.words[n] == words}
        numbers = ", ".join(str(number) for number in sorted(sources))
        parts.append(f"{count} {words} (like frame{'s' if len(sources) > 1 else ''} {numbers})")
    return "; ".join(parts)


def _detectable_size(study: Study, test: EffectTest, critical: float, information: float) -> float:
    """Return the root mean square that would be detected with this information, metres."""
    ols = study.sums.ols
    low, high = ols.layout.effects[test.name]
    scale = ols.scale * study.sums.count.sum()
    raw = float((ols.total[low:high, low:high] / scale).trace()) / (high - low)
    if information <= 0:
        return float("inf")
    size = np.sqrt(raw * noncentrality(test, critical) / information)
    # A metre is no error of a depth camera.
    return float(size) if size < 1 else float("inf")
