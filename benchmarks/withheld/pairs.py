"""Does `tofcorr diagnose --sim RECORDING` measure the gap, share it out, and name what is missing?

A pair is a camera's recording and that of a simulator of it, which lacks something. Truth comes
from frames without noise at the true poses: the gap as given is the RMS over the used pixels of
camera minus simulator. This difference is a sum of parts, one a cause; a share is the part's
Shapley value in the squared sum, which is its inner product with the sum. No data tell whose a
constant is, so that the mean of every part counts as distance.
"""

import math
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.renewed import ranges
from benchmarks.renewed.cases import agree, in_world, make_case, seeded, turn
from benchmarks.renewed.geometry import Array, Random, inverse
from benchmarks.renewed.recording import (
    Data,
    Recorded,
    depth_over_range,
    read,
    record,
    write_recording,
)
from benchmarks.renewed.signal_chain import Form, Hook, field_of, measure, noise_of, see
from benchmarks.renewed.world import BaseErrors, World, session_again
from benchmarks.sealed.answers import Entry, Outcome, load, seal
from benchmarks.sealed.command import Check
from benchmarks.sealed.oracle import at_other_poses, counted, linearise
from benchmarks.sealed.scores import (
    ANY,
    Score,
    at_least,
    at_most,
    known,
    scores_table,
    share_score,
)
from benchmarks.withheld.tiers import TEXTBOOK

Hooks = Sequence[Hook]
TERMS = ("distance", "pixel", "amplitude")
FORMS = tuple(TEXTBOOK.values())
NOISE_FACTORS = (1.0, 0.5, 2.0, 0.0)  # of the simulator's noise over the camera's
DROPOUT_SHARES = ranges.Range(0.003, 0.05, log=True)  # of the pixels on the target
UNKNOWN_TO_IDEAL = (
    *("amplitude.npy", "integration_time_us", "body_temperature_c", "room_temperature_c"),
    *("ambient", "modulation_frequency_hz"),
)
FIXED_MM, USUAL_MM = ranges.Range(5.0, 5.0), ranges.Range(2.0, 12.0, log=True)
STATIONS = {"frames": 60, "moving": False, "repeated": 1.0, "repeats": 3}
WITHIN = 0.05  # of the gap as given, of its square for shares, of ratios of noise and amplitude
DROPOUT_WITHIN = 0.002  # of the pixels on the target
NOTHING_MM = 1.0  # a gap that the robot's 0.3 mm and 0.3 mrad alone explain
GROSS = 8.0  # errors of more standard deviations of the noise are none of a gap, as in the stages
MOST = 1.1  # times the gap of the stage with effects may degraded frames leave
LEAST_GAP_MM = 0.5  # no degraded frame has to be nearer: the robot's 0.3 mm and 0.3 mrad
ONE_SIDED, TWO_SIDED = 1.645, 1.96  # normal quantiles of 95 % and 97.5 %
# Effects of the robot, the target or the room, which no sensor can add to depth images.
BEYOND_IMAGES = frozenset({"robot_kinematics", "target_shape", "target_registration", "multipath"})


@dataclass(frozen=True)
class Pair:
    """What one pair is made of.

    Attributes:
        withheld: Forms in the camera alone.
        shared: Forms in both.
        sizes: RMS of each, mm.
        terms: The camera's base errors that the simulator has as well.
        other_poses: Whether the simulator stands at poses of its own.
        noise: The simulator's noise over the camera's.
        dropouts: Shares of the pixels on the target: the camera's and the simulator's.
        gain: The camera's amplitude over the simulator's.
    """

    withheld: tuple[Form, ...] = ()
    shared: tuple[Form, ...] = ()
    sizes: ranges.Range = USUAL_MM
    terms: tuple[str, ...] = ()
    other_poses: bool = False
    noise: float = 0.0
    dropouts: tuple[float, float] = (0.0, 0.0)
    gain: float = 1.0


def _shared(index: int, rng: Random) -> Pair:
    one, other = turn(0, FORMS, index), FORMS[rng.integers(len(FORMS))]
    while not agree((one, other)):
        other = FORMS[rng.integers(len(FORMS))]
    return Pair((one,), (other,), terms=TERMS, noise=1.0)


def _noise(index: int, rng: Random) -> Pair:
    lost, exact = DROPOUT_SHARES.draw(rng), index % 4 == 0
    gain = 1.0 if exact else float(rng.uniform(0.8, 1.25))
    dropouts = (lost, lost if exact else 0.0)
    return Pair(terms=TERMS, noise=NOISE_FACTORS[index % 4], dropouts=dropouts, gain=gain)


def _one(index: int, kind: int) -> tuple[Form, ...]:
    """The form whose turn it is, in an order of the kind's own."""
    return (turn(kind, FORMS, index),)


KINDS: dict[str, Callable[[int, Random], Pair]] = {
    "ideal": lambda index, rng: Pair(_one(index, 1), sizes=FIXED_MM),
    "terms": lambda index, rng: Pair(
        _one(index, 2), terms=("distance", "pixel"), noise=NOISE_FACTORS[index % 4]
    ),
    "shared": _shared,
    "nothing": lambda index, rng: Pair(
        shared=_one(index // 2, 3) if index % 2 else (),
        terms=TERMS,
        noise=NOISE_FACTORS[index // 2 % 4],
    ),
    "other": lambda index, rng: Pair(
        _one(index, 4),
        terms=("distance", "pixel") if index % 2 else (),
        other_poses=True,
        noise=float(index % 2),
    ),
    "other_nothing": lambda index, rng: Pair(terms=TERMS, other_poses=True, noise=1.0),
    "noise": _noise,
}


def write_pair(seed: int, kind: str, index: int, out: Path) -> Entry:
    """Write one pair; return its entry: of the simulator's recording too, and of ideal frames."""
    rng = np.random.default_rng([seed, 1000 + list(KINDS).index(kind), index])
    pair = KINDS[kind](index, rng)
    with ranges.drawn_from(**ranges.PLAIN):
        forms = seeded((*pair.withheld, *pair.shared), int(rng.integers(2**32)))
        case = make_case(rng, forms, pair.sizes)
        world, count = case.world, len(pair.withheld)
        # The simulator's tool stands where the robot says, which is not quite where it is.
        slip = inverse(world.world_from_tool()) @ case.recorded.stated_poses
        simulated = _simulated(rng, case.world, case.hooks[count:], pair, slip)
    names = {part: f"r{rng.integers(2**48):012x}" for part in ("id", "sim")}
    still = _at_tool(world, np.broadcast_to(np.eye(4), slip.shape))
    truth = _truth(world, case.hooks, _simulator(still, pair), case.hooks[count:])
    camera, truth["real_dropouts"] = _dropped(rng, case.recorded, pair.dropouts[0])
    simulated, truth["sim_dropouts"] = _dropped(rng, simulated, pair.dropouts[1])
    truth["noise_ratio"] = 1 / pair.noise if pair.noise else None
    truth["amplitude_ratio"] = pair.gain
    fields = {one.form.effect: case.truth.fields[one.form.effect] for one in case.hooks[:count]}
    arrays = {f"field_{effect}": field for effect, field in fields.items()}
    arrays |= {"expected": case.truth.expected, "sigma": case.noise}
    write_recording(out / "recordings" / names["id"], camera)
    # An ideal simulator writes depth alone, without amplitude and conditions.
    without = () if pair.terms or pair.shared else UNKNOWN_TO_IDEAL
    write_recording(out / "recordings" / names["sim"], simulated, without)
    if kind == "ideal" and not world.design.moving:
        names["held_out"] = f"r{rng.integers(2**48):012x}"
        ideal, more = _held_out(rng, world, case.hooks)
        write_recording(out / "recordings" / names["held_out"], ideal)
        arrays |= more
    answer = {
        "role": "main",
        "index": index,
        "id": names["id"],
        "case": {"tier": kind, "shared": [one.effect for one in pair.shared], **case.described()},
        "sizes_mm": {effect: case.sizes_mm[effect] for effect in fields},
        "truth": truth,
    }
    return {**names, "exclude": [], "answer_sha256": seal(rng, out, answer, arrays)}


def _simulator(world: World, pair: Pair) -> World:
    """A world with the simulator's base errors and an exact hand-eye."""
    base, lens = world.sensor.base, world.sensor.lens
    parts = asdict(base)
    for term in TERMS:
        if term not in pair.terms:
            parts[f"of_{term}"] = tuple(0.0 for _ in parts[f"of_{term}"])
    lens = replace(lens, counts_per_electron=lens.counts_per_electron / pair.gain)
    sensor = replace(world.sensor, base=BaseErrors(**parts), lens=lens)
    design = replace(world.design, robot=0.0)
    return replace(world, sensor=sensor, design=design, guess=world.tool_from_camera)


def _at_tool(world: World, slip: Array) -> World:
    """The world with the tool at a transform (N, 4, 4) from where it is."""
    mount = world.tool_from_camera
    way, moved = world.way, inverse(mount) @ slip @ mount
    return replace(world, way=replace(way, camera_at=lambda late: way.camera_at(late) @ moved))


def _simulated(rng: Random, world: World, shared: Hooks, pair: Pair, slip: Array) -> Recorded:
    """The simulator's recording."""
    session = session_again(rng, world) if pair.other_poses else _at_tool(world, slip)
    there = _simulator(session, pair)
    recorded, truth = record(rng, there, in_world(there, shared))
    expected = truth.expected * depth_over_range(there)
    depth = expected + pair.noise * (recorded.depth - expected)
    return replace(recorded, depth=depth)


def _dropped(rng: Random, one: Recorded, chance: float) -> tuple[Recorded, float]:
    """The recording without some pixels, dark ones first, and the share that is missing of all."""
    dark = (1 + (one.amplitude / np.median(one.amplitude[one.mask])) ** 2) ** -1
    lost = np.where(one.mask, np.minimum(chance * dark / dark[one.mask].mean(), 1.0), 0.0)
    depth = np.where(rng.uniform(size=lost.shape) < lost, np.nan, one.depth)
    missing = float(np.where(np.isfinite(one.depth), lost, 1.0)[one.mask].mean())
    return replace(one, depth=depth), missing


def _truth(world: World, hooks: Hooks, simulator: World, shared: Hooks) -> Entry:
    """The gap as given, mm, and the share of each cause; both worlds stand at the true poses."""
    terms, effects, used = [], [], np.ones(1, dtype=bool)
    for one, own in ((world, hooks), (simulator, in_world(simulator, shared))):
        plain, seen = see(one), measure(one, own)
        used = used & plain.on_target & seen.view.on_target
        terms.append(one.sensor.base.terms(plain.distance, plain.amplitude / plain.bright))
        effects.append(seen.depth - plain.path)
    parts = {name: (terms[0][name] - terms[1][name] + 0 * used)[used] for name in TERMS}
    withheld = [one.form.effect for one in hooks if one not in shared]
    for name in withheld[:1]:
        parts[name] = parts.get(name, 0.0) + (effects[0] - effects[1])[used]
    constant = sum(part.mean() for part in parts.values())
    parts = {name: part - part.mean() for name, part in parts.items()}
    parts["distance"] += constant
    total = sum(parts.values(), np.zeros(1))
    square = float(np.sum(total**2))
    shares = {name: float(np.sum(part * total)) / square for name, part in parts.items() if square}
    size = 1e3 * float(np.sqrt(np.mean(total**2)))
    return {"as_given_mm": size, "shares": shares if size > 1e-3 else {}}


def _held_out(rng: Random, world: World, hooks: Hooks) -> tuple[Recorded, dict[str, Array]]:
    """Ideal frames of another session, and what the camera would measure there, metres."""
    session = session_again(rng, world, **STATIONS)
    own = in_world(session, hooks)
    clean, real = measure(session), measure(session, own)
    view, counts = clean.view, session.sensor.lens.counts_per_electron
    exact = replace(session, guess=session.tool_from_camera)
    depth = view.distance * depth_over_range(session)
    ideal = Recorded(exact, exact.world_from_tool(), depth, view.amplitude * counts, view.on_target)
    both = view.on_target & real.view.on_target
    arrays = {"held_out": np.where(both, real.depth, np.nan)}
    arrays["held_out_sigma"] = noise_of(session, own)
    for hook in own:
        field = field_of(measure(session, [hook]), clean)
        arrays[f"held_out_field_{hook.form.effect}"] = field
    return ideal, arrays


def read_degraded(out: Path, name: str, answer: Mapping[str, Any]) -> dict[str, float] | None:
    """Compare a pair's degraded frames with what the camera would measure; None without any.

    They are of another session, whose poses and conditions the diagnosis never saw. Neither side of
    a gap has noise, so that no floor is taken off. `own_mm` is what the camera leaves at the poses
    of the recording: the last stage, known exactly. `oracle_mm` is what least squares leave in the
    other session if they know the effect but for its strength, and are fitted to the recording as
    well. Pixels count whose distance and amplitude lie within those of the recording.
    `error_of_square` is the standard error of the square of the gap, with stations as the unit,
    mm^2; `missing` is a share of the pixels on the target.
    """
    parts = [out / part / name for part in ("degraded", "expected", "own")]
    if not all((part / "depth.npy").exists() for part in parts):
        return None
    drawn, predicted, own = (read(part) for part in parts)
    true, sigma = load(out, name, "held_out"), load(out, name, "held_out_sigma")
    real = read(out / "recordings" / name)
    met = np.where(within(predicted, real), true, np.nan)
    stations = drawn.columns["pose_id"]
    gap, error = gap_of(predicted.depth - met, sigma, stations)
    left = np.where(real.valid, own.depth - load(out, name, "expected"), np.nan)
    ideal = replace(predicted, depth=met, valid=np.isfinite(met))
    fields = [
        (load(out, name, f"field_{effect}"), load(out, name, f"held_out_field_{effect}"))
        for effect in answer["sizes_mm"]
    ]
    deviation = drawn.depth - predicted.depth
    both = np.isfinite(deviation) & np.isfinite(true)
    noise, true_noise = (1e3 * float(np.sqrt(np.mean(x[both] ** 2))) for x in (deviation, sigma))
    on_target = np.load(out / "degraded" / name / "mask.npy") > 0
    return {
        "gap_mm": gap,
        "error_of_square": error,
        "own_mm": gap_of(left, load(out, name, "sigma"), real.columns["pose_id"])[0],
        "oracle_mm": gap_of(oracle_error(real, ideal, fields), sigma, stations)[0],
        "noise_mm": noise,
        "true_noise_mm": true_noise,
        "missing": float(np.mean(~drawn.valid[on_target])),
        "true_missing": float(np.mean(~np.isfinite(true[on_target]))),
    }


def within(other: Data, recording: Data) -> np.ndarray:
    """Which pixels (N, H, W) have a distance and an amplitude that the recording has as well."""
    inside = np.ones(other.depth.shape, dtype=bool)
    for name in ("depth", "amplitude"):
        mine, theirs = getattr(other, name), getattr(recording, name)
        if mine is not None and theirs is not None:
            low, high = theirs[recording.valid].min(), theirs[recording.valid].max()
            inside &= (mine >= low) & (mine <= high)
    return inside


def gap_of(error: Array, sigma: Array, station: np.ndarray) -> tuple[float, float]:
    """Root mean square of errors (N, H, W), mm, weighted as the stages of a diagnosis are.

    Returns:
        It, and the standard error of its square, mm^2, with stations as the unit.
    """
    counts = np.isfinite(error) & (np.abs(np.nan_to_num(error)) < GROSS * sigma)
    weight = counts * counted(sigma)
    squares = (weight * np.nan_to_num(error) ** 2).sum((1, 2))
    _, row = np.unique(station, return_inverse=True)
    total, weights = np.bincount(row, squares), np.bincount(row, weight.sum((1, 2)))
    square = total.sum() / weights.sum()
    spread = np.sqrt(((total - square * weights) ** 2).sum()) / weights.sum()
    return 1e3 * float(np.sqrt(square)), 1e6 * float(spread)


def oracle_error(real: Data, ideal: Data, fields: list[tuple[Array, Array]]) -> Array:
    """Errors (N, H, W) in another session of a fit that has the effects' true fields as columns.

    Args:
        real: The recording that is fitted.
        ideal: The other session, with the true distances as its depth.
        fields: Of each effect, in the recording and in the other session, metres.
    """
    base = linearise(real)
    coefficients = base.with_columns(*(here[real.valid] for here, _ in fields)).coefficients
    there = at_other_poses(base, ideal)
    there = there.with_columns(*(other[ideal.valid] for _, other in fields))
    error = np.full(ideal.depth.shape, np.nan)
    error[ideal.valid] = there.columns @ coefficients - there.target
    return error


Figures = Mapping[str, float]
Held = dict[str, bool | None]
"""What is held against the truth, by figure; None was not measured."""

DEGRADED_NEAR = "degraded frames within 1.1 times the last stage"
TARGETS = {
    "gap as given within 5 %": at_least(0.95),
    "first number of the verdict within 5 %": at_least(0.95),
    "every share within 0.05": at_least(0.9),
    "effect in its set": at_least(0.95),
    "something else named": at_most(0.05),
    "an effect named that both have": at_most(0.05),
    "an effect named though none is missing": at_most(0.05),
}


def judge(one: Outcome, found: Figures | None = None) -> Held:
    """Hold what was said of one pair, and degraded frames, against the truth.

    A failed run is wrong in size, shares and cause.
    """
    truth, report, failed = one.answer["truth"], one.said.report, bool(one.said.failure)
    stages = {row["name"]: row for row in report.get("stages") or []}
    given = stages.get("as_given", {}).get("gap_mm")
    sets = [known(members) for members in one.said.sets]
    named = zip(one.said.effects, sets, strict=False)
    false = {name for name, members in named if not members & one.truths}
    if not truth["shares"]:
        return {
            "runs that failed": failed,
            "gap as given at most 1 mm": None if given is None else given <= NOTHING_MM,
            "an effect named though none is missing": None if failed else bool(false),
            **_blocks_right(report, truth),
        }
    # The first number of the verdict is what people read.
    first, shared = (
        re.search(r"(\d+(?:\.\d+)?) mm", report.get("verdict") or ""),
        {*one.case["shared"]},
    )
    in_set, read_first = any(members & one.truths for members in sets), first and float(first[1])
    sizes: Held = {
        "gap as given within 5 %": _near(given, truth["as_given_mm"]),
        "first number of the verdict within 5 %": _near(read_first, truth["as_given_mm"]),
        "every share within 0.05": _shares_right(one, sets),
    }
    return {
        "runs that failed": failed,
        **(dict.fromkeys(sizes, False) if failed else sizes),
        "effect in its set": in_set,
        "effect in its set, of those findable": in_set if one.must_find else None,
        "something else named": None if failed else bool(false),
        "an effect named that both have": bool(shared & false) if shared and not failed else None,
        **_images_right(one, stages.get("with_effects", {}), found),
    }


def _near(said: float | None, true: float | None) -> bool | None:
    known = said is not None and true is not None and not math.isnan(said)
    return abs(said / true - 1) <= WITHIN if known else None  # type: ignore[operator]


def _blocks_right(report: Mapping[str, Any], truth: Mapping[str, Any]) -> Held:
    """Whether noise, missing pixels and amplitude are right."""
    noise, lost = report.get("noise") or {}, report.get("dropouts")
    real, sim = noise.get("real_mm"), noise.get("sim_mm")
    off = [lost[f"{who}_share"] - truth[f"{who}_dropouts"] for who in ("real", "sim") if lost]
    ratio = (report.get("amplitude") or {}).get("ratio")
    return {
        "noise ratio within 5 %": _near(real / sim if real and sim else None, truth["noise_ratio"]),
        "dropout shares within 0.002": max(map(abs, off)) <= DROPOUT_WITHIN if off else None,
        "amplitude ratio within 5 %": _near(ratio, truth["amplitude_ratio"]),
    }


def _meant(one: Outcome, cause: str, sets: Sequence[frozenset[str]]) -> str:
    """A cause; what was said of an effect whose set holds the true one is said of the true one."""
    (cause,) = known([cause])
    for members in sets:
        for true in one.truths:
            if {cause, true} <= members and cause not in ("hand_eye", *TERMS):
                return true
    return cause


def _shares_right(one: Outcome, sets: Sequence[frozenset[str]]) -> bool | None:
    """Whether every share that is there or was said is right."""
    if not one.said.report.get("attribution"):
        return None
    errors = {name: -share for name, share in one.answer["truth"]["shares"].items()}
    for row in one.said.report["attribution"]:
        name = _meant(one, row["cause"], sets)
        errors[name] = errors.get(name, 0.0) + row["share"]
    return all(abs(error) <= WITHIN for error in errors.values())


def shares_covered(one: Outcome) -> list[bool]:
    """Whether each share that was said has the true one in its interval."""
    true, sets = one.answer["truth"]["shares"], [known(members) for members in one.said.sets]
    return [
        row["ci"][0] <= true.get(_meant(one, row["cause"], sets), 0.0) <= row["ci"][1]
        for row in one.said.report.get("attribution") or []
        if row.get("ci") and row["kind"] != "unexplained"
    ]


def _images_right(one: Outcome, stage: Mapping[str, Any], found: Figures | None) -> Held:
    """Whether degraded frames are as near, as noisy and as full as they should be.

    *Not significantly more*: squares are compared, for these have normal errors (one-sided, 5 %);
    that of the stage is in its interval.
    """
    if found is None or "gap_mm" not in stage:
        return {}
    most = MOST * max(stage["gap_mm"], LEAST_GAP_MM)
    near = found["gap_mm"] <= most
    excess = found["gap_mm"] ** 2 - (MOST * stage["gap_mm"]) ** 2
    low, high = stage["ci"]
    error = math.hypot(MOST**2 * (high**2 - low**2) / (2 * TWO_SIDED), found["error_of_square"])
    noise, lost = found["noise_mm"] / found["true_noise_mm"], found["true_missing"]
    of_images: Held = {
        "the same, of effects that a depth image can show": near,
        "these, or not significantly more": near or excess <= ONE_SIDED * error,
        "these, within 1.1 times what the stage truly leaves": (
            found["gap_mm"] <= MOST * max(found["own_mm"], LEAST_GAP_MM)
        ),
        "the last stage, by an oracle's fit to the same frames": found["oracle_mm"] <= most,
        "their missing pixels within 10 % or 0.002": (
            abs(found["missing"] - lost) <= max(2 * WITHIN * lost, DROPOUT_WITHIN)
        ),
    }
    if one.truths & BEYOND_IMAGES:
        of_images = dict.fromkeys(of_images)
    noise_right = abs(noise - 1) <= 2 * WITHIN
    return {DEGRADED_NEAR: near, **of_images, "noise of degraded frames within 10 %": noise_right}


def score_all(outcomes: Sequence[Outcome], out: Path) -> tuple[list[Score], str]:
    """All figures of the kinds that are there, and them as text."""
    scores: list[Score] = []
    for kind in KINDS:
        cases = [one for one in outcomes if one.tier == kind]
        held = [judge(one, read_degraded(out, one.name, one.answer)) for one in cases]
        for what in dict.fromkeys(what for row in held for what in row):
            judged = [row.get(what) for row in held]
            scores.append(share_score(kind, what, judged, TARGETS.get(what, ANY)))
        covered = [found for one in cases for found in shares_covered(one)]
        scores.append(share_score(kind, "single shares in their intervals", covered))
    scores = [one for one in scores if one.count]
    return scores, scores_table(scores)


pairs = Check(
    "Check `tofcorr diagnose --sim RECORDING` on pairs of a camera and a simulator.",
    "kind",
    dict.fromkeys(KINDS, ""),
    lambda *case: [write_pair(*case)],
    score_all,
    cases=40,
).group
