"""What to record next, so that more can be concluded, and what would have been found."""

import math
from collections import Counter
from collections.abc import Collection
from dataclasses import replace

import torch
from scipy import special
from torch import Tensor

from tofcorr.diagnosis.findings.naming import NamedEffects
from tofcorr.diagnosis.sums.linear_system import BASE, PoseSums, pose_columns, pose_sums
from tofcorr.diagnosis.sums.noise import brightness_of
from tofcorr.diagnosis.sums.observations import (
    TINY,
    Observations,
    effect_inputs,
    predicted_distance,
)
from tofcorr.diagnosis.sums.study import (
    LEAST_LEFT,
    Study,
    absorbed_share,
    hidden_effects,
    left_over,
    signal,
)
from tofcorr.geometry import se3
from tofcorr.pixels.sample import thinned
from tofcorr.simulation.effects import CATALOGUE
from tofcorr.simulation.effects.base import is_clock
from tofcorr.simulation.hooks import FrameFacts

Change = tuple[str, str, Tensor]
"""A description, what of the frames' facts it changes, and that of each changed frame."""


Candidates = tuple[list[str], list[int], PoseSums]
"""Frames that could be recorded: how each differs from the recorded frame that it is made from;
that frame; and sums over their pixels, each candidate one unit, poses as uncertain as recorded."""


def make_candidates(study: Study, names: Collection[str]) -> Candidates | None:
    """Vary pose and conditions of a dozen recorded frames, one at a time.

    Args:
        study: The recording.
        names: Effects whose columns are needed; the sums hold no others.

    Returns:
        None for a recording that states nothing which could be varied: neither poses of a moving
        tool, nor a clock, nor other conditions.
    """
    facts, frames = study.observations.facts, study.observations.frame.unique()
    sources = torch.from_numpy(thinned(frames.numpy(), 12))
    known = {name: own[sources] for name, own in vars(facts).items() if own is not None}
    changes = [*_other_conditions(study, known), *_other_poses(study, sources)]
    if not changes:
        return None
    joined = {
        name: torch.cat([values if name == changed else own for _, changed, values in changes])
        for name, own in known.items()
    }
    source = sources.repeat(len(changes))
    shown = _observations(study, replace(facts, **joined), source)
    words = [words for words, _, _ in changes for _ in sources]
    return words, source.tolist(), _sums(study, shown, names)


def _other_conditions(study: Study, known: dict[str, Tensor]) -> list[Change]:
    """Return the changes of time, exposure, temperature and light of frames of known facts."""
    facts, changes = study.observations.facts, list[Change]()
    if is_clock(facts.timestamp):
        seconds = torch.arange(len(known["timestamp"])).double()
        later = 1.02 * float(facts.timestamp.max()) + 60.0
        changes.append(("in the first minute after power-on", "timestamp", 1.0 + seconds))
        changes.append(("after all others", "timestamp", later + seconds))
    ambient = torch.zeros(1) if facts.ambient is None else facts.ambient.nan_to_num(0.0)
    strong = 2.0 * float(ambient.max()) + 100.0
    rows = (
        ("with half the integration time", "integration_time", 0.5, 0.0),
        ("with twice the integration time", "integration_time", 2.0, 0.0),
        ("with the room 4 degrees warmer", "room_temperature", 1.0, 4.0),
        ("with the room 4 degrees colder", "room_temperature", 1.0, -4.0),
        ("with a lamp on", "ambient", 1.0, strong),
        ("in the dark", "ambient", 0.0, 0.0),
    )
    return changes + [(said, n, a * known[n] + b) for said, n, a, b in rows if n in known]


def _other_poses(study: Study, sources: Tensor, *, tilt: float = 0.35) -> list[Change]:
    """Turn the camera about the point where its axis meets the target, and move it along the axis.

    Args:
        study: The recording.
        sources: Numbers of the frames, shape (S,).
        tilt: Radians: 20 degrees, what a robot arm can turn before a wall. Chosen.
    """
    if not study.observations.recording.moves:
        return []
    pose, seen = study.fit.tool_from_camera, study.observations.frame
    total = torch.bincount(seen, study.inputs.radial_distance)[sources]
    distance = total / torch.bincount(seen).clamp(min=1)[sources]
    nearer = 0.3  # Chosen.
    changes = []
    for words, factor, place, angle in (
        ("tilted up or down by +20 degrees", 1.0, 3, tilt),
        ("tilted up or down by -20 degrees", 1.0, 3, -tilt),
        ("tilted to the side by +20 degrees", 1.0, 4, tilt),
        ("tilted to the side by -20 degrees", 1.0, 4, -tilt),
        ("from 30 % nearer", 1 - nearer, 3, 0.0),
        ("from 30 % farther", 1 + nearer, 3, 0.0),
    ):
        forth, turn, back = torch.zeros(3, len(sources), 6, dtype=torch.float64)
        forth[:, 2], turn[:, place], back[:, 2] = distance, angle, -factor * distance
        moved = pose @ se3.exp(forth) @ se3.exp(turn) @ se3.exp(back) @ se3.inverse(pose)
        world_from_tool = study.observations.facts.world_from_tool[sources]
        changes.append((words, "world_from_tool", world_from_tool @ moved))
    return changes


# Distance below which pixels are not used, metres: nearer than time-of-flight cameras measure.
_NEAREST = 0.1


def _observations(study: Study, facts: FrameFacts, source: Tensor) -> Observations:
    """Return about 150 pixels of each candidate, with amplitudes scaled from their sources.

    Args:
        study: The recording.
        facts: Of the candidates.
        source: The recorded frame that each is made from.
    """
    old = study.observations
    ends = [old.frame_ends[frame] for frame in source.tolist()]
    places = [torch.arange(low, end, max(1, (end - low) // 150)) for low, end in ends]
    place = torch.cat(places)
    made = replace(
        old.at(place),
        facts=facts,
        frame=torch.arange(len(source)).repeat_interleave(torch.tensor(list(map(len, places)))),
        amplitude_images=None if old.amplitude_images is None else old.amplitude_images[source],
        distance_images=old.distance_images[source],
        on_target=torch.ones_like(old.on_target[source]),
        unit=torch.arange(len(source)),
        wall=None if old.wall is None else old.wall[source],
    )
    distance = predicted_distance(made, study.fit.tool_from_camera)
    before = study.inputs.radial_distance[place]
    usable = (distance > _NEAREST) & distance.isfinite() & (distance < 3 * before)
    distance = torch.where(usable, distance, before)
    amplitude, time, new = made.amplitude, old.facts.integration_time, facts.integration_time
    if amplitude is not None:
        amplitude = amplitude * (before / distance) ** 2
        if time is not None and new is not None:
            amplitude = amplitude * (new / time[source])[made.frame].nan_to_num(1.0)
    return replace(made, measured=distance, amplitude=amplitude)


def _sums(
    study: Study, made: Observations, names: Collection[str], *, steepest: float = 0.3
) -> PoseSums:
    """Return the sums over candidates of base model and some effects.

    Args:
        study: The recording.
        made: Pixels of the candidates.
        names: The effects.
        steepest: Cosine of incidence below which pixels are not used: 73 degrees. Chosen.
    """
    pose, layout = study.fit.tool_from_camera, study.sums.layout
    inputs = effect_inputs(made, pose)
    seen = (inputs.radial_distance > _NEAREST) & (inputs.incidence_cosine > steepest)
    _, base = study.fit.model.on(made).linearised(pose)
    # What is uncertain of the simulator's own error, or of the amplitude, is not computed anew.
    rest = base.new_zeros(len(base), layout.base - base.shape[1])
    columns = {BASE: torch.cat([base, rest], dim=1)}
    for name in names:
        columns[name] = study.effects[name].scaled_columns(inputs)
    for part in columns.values():
        seen &= part.isfinite().all(dim=1)
    sigma = study.fit.noise.at(brightness_of(made), torch.zeros_like(made.frame))
    # The few pixels get the weight of all pixels that a frame of the recording has.
    full = len(study.observations.measured) / study.observations.num_frames
    stand_for = full / max(len(made.measured) / made.num_frames, 1.0)
    trust, zero = seen.double() * stand_for, torch.zeros_like(sigma)
    fit = replace(study.fit, residual=zero, sigma=sigma, trust=trust)
    sums = pose_sums(
        made,
        {name: torch.where(seen[:, None], own, 0.0) for name, own in columns.items()},
        torch.where(seen[:, None], pose_columns(inputs).nan_to_num(0.0), 0.0),
        fit,
        layout.prior[: layout.base, : layout.base],
    )
    return replace(sums, pose_sd=study.sums.pose_sd, dispersion=study.sums.dispersion)


def minimum_detectable(study: Study, named: NamedEffects, seed: int) -> dict[str, float | None]:
    """Return the size of each effect that would be found with 80 % probability, metres.

    The size is the root mean square of the effect's signal over all pixels, before base model and
    hand-eye transform absorb their share. Of random directions in the space of an effect's
    coefficients, 64 of them, it is the median. None: the effect is not identifiable, because they
    absorb all of it.

    Args:
        study: The recording.
        named: The effects named.
        seed: Of the random directions.
    """
    generator = torch.Generator().manual_seed(seed)
    found: dict[str, float | None] = {}
    for name in named.closed:
        if name not in study.effects:  # A map of independent values.
            needed = noncentrality(study, len(study.maps[name].coefficients))
            detectable = (needed / float(study.weight.sum())) ** 0.5
            found[name] = max(detectable, study.material_mm / 1000)
        elif 1 - absorbed_share(study, name) < LEAST_LEFT:
            found[name] = None
        else:
            size = len(range(*study.sums.layout.effects[name]))
            drawn = torch.randn(64, size, generator=generator, dtype=torch.float64)
            found[name] = _of_columns(study, name, drawn)
    return found


def noncentrality(study: Study, columns: int, power: float = 0.8) -> float:
    """Return the noncentrality at which an effect is named.

    The log predictive density of held-out poses rises by half of a noncentral chi-squared, less one
    for each column; that must exceed the price of an effect.

    Args:
        study: The recording.
        columns: Of the effect.
        power: In which share of cases. The usual choice in the design of experiments.
    """
    least = 2 * (columns - math.log(study.options.tests.odds))
    return float(special.chndtrinc(least, columns, 1 - power))


def _of_columns(study: Study, name: str, drawn: Tensor) -> float:
    """Return the median size of an effect that would be found, in directions (D, E), metres."""
    gls, ols = study.sums.gls, study.sums.ols
    own = torch.arange(*ols.layout.effects[name])
    members = torch.arange(study.fit.model.num_columns)
    prior, pixels = ols.layout.prior_of(members), ols.scale * float(study.sums.count.sum())
    signal, size, remains = (
        torch.einsum("di,ij,dj->d", drawn, matrix, drawn).clamp(min=TINY)
        for matrix in (
            left_over(gls.total, members, own, prior),
            ols.total[own][:, own],
            study.unabsorbed[own][:, own],
        )
    )
    detectable = (size / pixels / signal * noncentrality(study, len(own))).sqrt()
    reportable = (size / remains).sqrt() * study.material_mm / 1000
    return float(torch.maximum(detectable, reportable).median())


Question = tuple[str, tuple[str, ...]]
"""An effect to identify, and those to distinguish it from, besides the calibration."""


def next_recording(study: Study, named: NamedEffects) -> list[str]:
    """Return what to record next, the most useful first, in sentences.

    First which frames would distinguish the effects of a cause set, or show an effect that the
    calibration absorbs; then the inputs of effects that could not be tested.
    """
    asked, candidates = _questions(study, named), None
    if asked:
        names = {name for one, others in asked for name in (one, *others)}
        candidates = make_candidates(study, names)
    advice: list[str] = []
    for effect, others in asked:
        goal = f"To observe {effect}, which calibration absorbs"
        if others:
            goal = f"To distinguish {effect} from {' and '.join(others)}"
        if candidates is not None:
            goal += _advised(study, candidates, (effect, others)) + " In general"
        advice.append(f"{goal}: {CATALOGUE[effect].remedy}.")
    return advice + [
        f"{name} could not be tested: it needs {', '.join(wants)}. Best: {CATALOGUE[name].remedy}."
        for name, wants in study.missing.items()
    ]


def _questions(study: Study, named: NamedEffects) -> list[Question]:
    """Return the cause sets to be separated, then the effects that calibration absorbs.

    Three at most: what a person records in one go.
    """
    effects = study.effects
    sets = [(own[0], own[1:]) for own in named.cause_sets if len(own) > 1]
    asked = [one for one in sets if effects.keys() >= {one[0], *one[1]}]
    hidden = (name for name in hidden_effects(study) if name not in named.names)
    return [*asked, *((name, ()) for name in hidden)][:3]


def _advised(study: Study, candidates: Candidates, question: Question) -> str:
    """Choose the most informative frames for one question, one after another; describe them.

    Args:
        study: The recording.
        candidates: What could be recorded.
        question: What the frames should tell.
    """
    (described, sources, sums), (effect, others) = candidates, question
    number = 8  # Chosen: what a person records in one go.
    names, layout, ols = [*others, effect], study.sums.layout, study.sums.ols
    prior = layout.prior_of(layout.of(others))
    known, own = torch.arange(len(layout.of(names))).tensor_split([len(prior)])
    total, frames, _ = study.sums.gls.of(names)
    total, frames = total.sum(0), sums.gls.of(names)[0]

    def information(gram: Tensor) -> Tensor:
        """Return the information on the effect, per coefficient, given calibration and others."""
        return left_over(gram, known, own, prior).diagonal(dim1=-2, dim2=-1).mean(-1)

    before, picked = float(information(total)), list[int]()
    for _ in range(number):
        gains = information(total + frames)
        gains[picked] = -torch.inf
        picked.append(int(gains.argmax()))
        total = total + frames[picked[-1]]
    after = float(information(total))
    listed = []
    for words, count in Counter(described[k] for k in picked).most_common():
        alike = sorted({sources[k] for k in picked if described[k] == words})
        numbers = ", ".join(map(str, alike))
        listed.append(f"{count} {words} (like frame{'s' * (len(alike) > 1)} {numbers})")
    advice = f", record {number} more frames: {'; '.join(listed)}. It could then be detected"
    raw = signal(study, effect) / (len(own) * ols.scale * float(study.sums.count.sum()))
    needed = noncentrality(study, len(own))
    now, then = ((raw * needed / max(one, TINY)) ** 0.5 for one in (before, after))
    if before > 0 and now < 1:  # A metre is no error of a depth camera.
        advice += f" from {1e3 * then:.1f} mm on, instead of {1e3 * now:.1f} mm"
    return advice + "."
