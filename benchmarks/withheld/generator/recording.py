"""One recording: a world observed with its effects and noise, and what is true of it."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from benchmarks.withheld.generator.effect import Applied, Effect
from benchmarks.withheld.generator.noise import Noise, noisy_taps, pose_noise, row_noise
from benchmarks.withheld.generator.observe import demodulate, look, taps_of
from benchmarks.withheld.generator.rigid import Array
from benchmarks.withheld.generator.strength import error_field, scale_to
from benchmarks.withheld.generator.world import World


@dataclass(frozen=True)
class Truth:
    """What is withheld: effects, each one's error (N, H, W), distance without noise; metres."""

    applied: tuple[Applied, ...]
    fields: Mapping[str, Array]
    sizes_mm: Mapping[str, float]  # RMS of each field over the used pixels
    expected: Array


@dataclass(frozen=True)
class Recorded:
    """What the camera and the robot give."""

    world: World
    stated_poses: Array  # world_from_tool (N, 4, 4)
    depth: Array  # (N, H, W), NaN where nothing returned
    amplitude: Array  # counts
    mask: np.ndarray


def record(
    rng: np.random.Generator, world: World, wanted: Sequence[tuple[Effect, float]], noise: Noise
) -> tuple[Recorded, Truth]:
    """Record a world with effects scaled to the wanted RMS errors in metres."""
    undisturbed = look(world)
    scaled = [scale_to(undisturbed, effect, size) for effect, size in wanted]
    return _record(
        rng,
        world,
        [one for one, _ in scaled],
        [field for _, field in scaled],
        undisturbed.used,
        noise,
    )


def record_again(
    rng: np.random.Generator, world: World, applied: Sequence[Applied], noise: Noise
) -> tuple[Recorded, Truth]:
    """Record another session of a setup with its effects as strong as before."""
    undisturbed = look(world)
    fields = [error_field(undisturbed, one) for one in applied]
    return _record(rng, world, applied, fields, undisturbed.used, noise)


def _record(
    rng: np.random.Generator,
    world: World,
    applied: Sequence[Applied],
    fields: Sequence[Array],
    used: np.ndarray,
    noise: Noise,
) -> tuple[Recorded, Truth]:
    view = look(world, applied)
    taps = taps_of(view, applied)
    camera = world.camera
    noisy = noisy_taps(rng, taps, noise, camera.unambiguous_range / (2 * np.pi))
    depth, amplitude = demodulate(noisy, camera.unambiguous_range)
    depth += row_noise(rng, noise, depth.shape)
    recorded = Recorded(
        world=world,
        stated_poses=world.world_from_tool() @ pose_noise(rng, noise, world.trajectory.pose_id),
        depth=np.where(view.used | ~view.on_target, depth, np.nan),
        amplitude=amplitude * camera.counts_per_electron,
        mask=view.on_target,
    )
    sizes = {
        one.effect.name: 1e3 * float(np.sqrt(np.mean(field[used] ** 2)))
        for one, field in zip(applied, fields, strict=True)
    }
    named = {one.effect.name: field for one, field in zip(applied, fields, strict=True)}
    return recorded, Truth(
        tuple(applied), named, sizes, demodulate(taps, camera.unambiguous_range)[0]
    )
