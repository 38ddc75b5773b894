"""Recordings of a camera and of a simulator of it, and what is true of the two."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from benchmarks.withheld.generator.catalogue import draw_effect
from benchmarks.withheld.generator.conditions import after_rest
from benchmarks.withheld.generator.effect import Applied
from benchmarks.withheld.generator.noise import NOISES, noisy_taps, pose_noise
from benchmarks.withheld.generator.observe import demodulate, look, taps_of
from benchmarks.withheld.generator.pair_cases import PairCase
from benchmarks.withheld.generator.pair_truth import (
    Expected,
    centred_parts,
    expect,
    parts_of,
    shares,
    size_mm,
)
from benchmarks.withheld.generator.poses import Design
from benchmarks.withheld.generator.recording import Recorded
from benchmarks.withheld.generator.rigid import Array
from benchmarks.withheld.generator.simulators import (
    at_other_poses,
    at_poses_of,
    kept,
    simulator_setup,
)
from benchmarks.withheld.generator.strength import error_field, scale_to
from benchmarks.withheld.generator.world import World, draw_setup, draw_world

NOISE = replace(NOISES["usual"], tail=np.inf)  # normal: its size is its standard deviation
NOTHING_MM = 1e-3  # below, a gap is rounding and has no shares
HELD_OUT = Design(frames=60, repeats=20)  # 20 stations, three frames each


@dataclass(frozen=True)
class HeldOut:
    """Ideal frames at poses of their own, and what the camera would measure there, metres."""

    ideal: Recorded
    expected: Array  # (N, H, W), NaN where the camera sees no target
    sigma: Array  # (N, H, W), standard deviation of its noise, metres
    fields: Mapping[str, Array]  # as those of the pair


@dataclass(frozen=True)
class Pair:
    """Two recordings, what is withheld from the simulator, and what is true of both."""

    real: Recorded
    simulated: Recorded
    fields: Mapping[str, Array]  # error (N, H, W) of each withheld effect, metres
    expected: Array  # (N, H, W), the camera's distances without noise
    sigma: Array  # (N, H, W), standard deviation of its noise, metres
    truth: Mapping[str, Any]
    held_out: HeldOut | None


def record_pair(rng: np.random.Generator, case: PairCase) -> Pair:
    """Draw a camera, and record it and its simulator."""
    setup = draw_setup(rng)
    if case.renderer:  # which draws pinhole images
        setup = replace(setup, camera=replace(setup.camera, distortion=(0.0,) * 5))
    world = draw_world(rng, setup, case.design)
    undisturbed = look(world)
    drawn = [
        [scale_to(undisturbed, draw_effect(name, rng), 1e-3 * size)[0] for name, size in wanted]
        for wanted in (case.withheld, case.shared)
    ]
    withheld, shared = drawn
    everything = [*shared, *withheld]
    stated = pose_noise(rng, NOISE, world.trajectory.pose_id)
    real = expect(world, everything)
    seen = _measured(rng, world, everything, 1.0)
    camera = _recorded(world, world.world_from_tool() @ stated, seen)
    rendered, simulated = _simulated(rng, world, case, shared, stated)
    camera, rendered, dropouts = _dropped(rng, case, camera, rendered)
    return Pair(
        real=camera,
        simulated=rendered,
        fields={one.effect.name: error_field(undisturbed, one) for one in withheld},
        expected=real.distance,
        sigma=real.sigma,
        truth=_truth(real, simulated, case) | dropouts | _noise_of(camera, real.distance, case),
        held_out=_held_out(rng, world, withheld, shared) if case.held_out else None,
    )


def _simulated(
    rng: np.random.Generator, world: World, case: PairCase, shared: Sequence[Applied], stated: Array
) -> tuple[Recorded, Expected]:
    """The simulator's recording, and what it expects at the camera's true poses."""
    setup = simulator_setup(rng, world.setup, case)
    if case.other_poses:
        there = at_other_poses(rng, world, setup)
    else:
        there = at_poses_of(world, setup, stated)
    seen = _measured(rng, there, shared, case.noise)
    still = np.broadcast_to(np.eye(4), stated.shape)
    return _recorded(there, there.world_from_tool(), seen), expect(
        at_poses_of(world, setup, still), shared
    )


def _measured(
    rng: np.random.Generator, world: World, effects: Sequence[Applied], noise: float
) -> tuple[Array, Array, np.ndarray]:
    """Distance, amplitude in electrons (N, H, W), and which pixels see the target."""
    view = look(world, effects)
    taps = taps_of(view, effects)
    full = world.camera.unambiguous_range
    drawn = noisy_taps(rng, taps, NOISE, full / (2 * np.pi))
    depth, amplitude = demodulate(taps + noise * (drawn - taps), full)
    return np.where(view.used | ~view.on_target, depth, np.nan), amplitude, view.on_target


def _recorded(world: World, poses: Array, seen: tuple[Array, Array, np.ndarray]) -> Recorded:
    depth, amplitude, mask = seen
    return Recorded(world, poses, depth, amplitude * world.camera.counts_per_electron, mask)


def _dropped(
    rng: np.random.Generator, case: PairCase, camera: Recorded, simulated: Recorded
) -> tuple[Recorded, Recorded, dict[str, Any]]:
    """Drop pixels at random, and say how many are missing in expectation."""
    result, told = [], {}
    for who, one, wanted in zip(("real", "sim"), (camera, simulated), case.dropouts, strict=True):
        chance = np.where(one.mask, _chance(one, wanted, case.dark_dropouts), 0.0)
        gone = rng.uniform(size=chance.shape) < chance
        result.append(replace(one, depth=np.where(gone, np.nan, one.depth)))
        missing = np.where(np.isfinite(one.depth), chance, 1.0)
        told[f"{who}_dropouts"] = float(missing[one.mask].mean())
    return result[0], result[1], told


def _chance(one: Recorded, share: float, dark: bool) -> Array:
    """Chance (N, H, W) of a pixel on the target to be missing; `share` on average."""
    if not dark or share == 0:
        return np.full(one.depth.shape, share)
    steep = (1 + (one.amplitude / np.median(one.amplitude[one.mask])) ** 2) ** -1
    scale = share / steep[one.mask].mean()
    return np.minimum(scale * steep, 1.0)


def _truth(real: Expected, simulated: Expected, case: PairCase) -> dict[str, Any]:
    effect = case.withheld[0][0] if case.withheld else ""
    parts = parts_of(real, simulated, effect)
    size = size_mm(parts)
    told: dict[str, Any] = {"as_given_mm": size, "shares": {}, "own_constant_shares": {}}
    if size > NOTHING_MM:
        told["shares"] = shares(centred_parts(parts))
        told["own_constant_shares"] = shares(parts)
    rms = {name: 1e3 * float(np.sqrt(np.mean(part**2))) for name, part in parts.items()}
    return told | {"parts_mm": rms}


def _noise_of(camera: Recorded, expected: Array, case: PairCase) -> dict[str, Any]:
    """Noise that is in the camera's recording, RMS, and the camera's over the simulator's."""
    error = (camera.depth - expected)[camera.mask]
    real = 1e3 * float(np.sqrt(np.nanmean(error**2)))
    ratio = 1 / case.noise if case.noise else None
    return {"real_noise_mm": real, "noise_ratio": ratio, "amplitude_ratio": case.amplitude_gain}


def _held_out(
    rng: np.random.Generator, world: World, withheld: Sequence[Applied], shared: Sequence[Applied]
) -> HeldOut:
    """Ideal frames of the same setup in another session, and what the camera would see there."""
    exact = replace(
        world.setup,
        base=kept(world.setup.base, ()),
        tool_from_camera_guess=world.setup.tool_from_camera,
    )
    session = draw_world(rng, world.setup, HELD_OUT)
    session = replace(
        session,
        target=replace(world.target, checkerboard=session.target.checkerboard),
        conditions=after_rest(
            session.conditions, session.trajectory.timestamps, world.conditions.heat_seconds
        ),
    )
    real = expect(session, [*shared, *withheld])
    ideal = replace(session, setup=exact)
    view = look(ideal)
    return HeldOut(
        _recorded(ideal, ideal.world_from_tool(), (view.distance, view.amplitude, view.on_target)),
        np.where(view.used & real.used, real.distance, np.nan),
        real.sigma,
        {one.effect.name: error_field(real.plain, one) for one in withheld},
    )
