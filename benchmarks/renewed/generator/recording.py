"""One recording with what is true of it."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from benchmarks.renewed.generator.form import Hook
from benchmarks.renewed.generator.masks import mask_of
from benchmarks.renewed.generator.measure import Measured, measure
from benchmarks.renewed.generator.strength import field_of
from benchmarks.renewed.generator.world import World
from benchmarks.withheld.generator.rigid import Array, small_motions

WEAKEST = 3.0  # times its noise: a weaker amplitude is no return
FAINT = 2e-4  # metres of noise, for the program needs some
LEAST_NEAR_PIXELS = 6  # on the target in a frame; with fewer the frame has an empty mask


@dataclass(frozen=True)
class Recorded:
    """What camera and robot give."""

    world: World
    stated_poses: Array  # world_from_tool (N, 4, 4)
    depth: Array  # (N, H, W) of the kind that the camera gives, NaN where nothing returned
    amplitude: Array  # counts
    mask: np.ndarray


@dataclass(frozen=True)
class Truth:
    """What is withheld, metres: each effect's error, and the radial distance without noise."""

    hooks: tuple[Hook, ...]
    fields: Mapping[str, Array]
    expected: Array

    def sizes_mm(self, used: np.ndarray) -> dict[str, float]:
        """RMS of each field over pixels."""
        return {
            name: 1e3 * float(np.sqrt(np.mean(field[used] ** 2)))
            for name, field in self.fields.items()
        }


def record(rng: np.random.Generator, world: World, hooks: Sequence[Hook]) -> tuple[Recorded, Truth]:
    """Record a world with effects."""
    clean, expected = measure(world), measure(world, hooks)
    seen = measure(world, hooks, rng)
    fields = {hook.form.effect: field_of(measure(world, [hook]), clean) for hook in hooks}
    depth = seen.depth
    if world.sensor.rounding:
        depth = np.round(depth / world.sensor.rounding) * world.sensor.rounding
    depth = np.where(_returned(seen), depth, np.nan)
    design = world.design
    mask = mask_of(rng, seen, depth, design.mask, design.ransac)
    if not design.mask.startswith("RANSAC"):
        mask = mask & clean.view.on_target
    mask &= mask.sum(axis=(1, 2), keepdims=True) >= LEAST_NEAR_PIXELS
    slip = design.robot
    count = int(world.way.pose_id[-1]) + 1
    noise = small_motions(
        slip * rng.standard_normal((count, 3)), slip * rng.standard_normal((count, 3))
    )
    recorded = Recorded(
        world=world,
        stated_poses=world.world_from_tool() @ noise[world.way.pose_id],
        depth=depth * depth_over_range(world),
        amplitude=seen.amplitude * world.sensor.lens.counts_per_electron,
        mask=mask,
    )
    return recorded, Truth(tuple(hooks), fields, expected.depth)


def exactly(rng: np.random.Generator, recorded: Recorded, truth: Truth) -> Recorded:
    """The same recording by a perfect robot, with `FAINT` noise and without rounding."""
    faint = truth.expected + FAINT * rng.standard_normal(truth.expected.shape)
    depth = np.where(np.isnan(recorded.depth), np.nan, faint * depth_over_range(recorded.world))
    return replace(recorded, depth=depth, stated_poses=recorded.world.world_from_tool())


def depth_over_range(world: World) -> Array:
    """What the recording's depth is of the radial distance (H, W)."""
    rays = world.sensor.lens.rays()
    return rays[..., 2] if world.sensor.depth_kind == "z" else np.ones(rays.shape[:2])


def _returned(seen: Measured) -> np.ndarray:
    noise = np.sqrt(seen.view.amplitude + world_background(seen)) / np.sqrt(2)
    return (seen.amplitude > WEAKEST * noise) & (seen.depth > 0)


def world_background(seen: Measured) -> float:
    """Electrons of read noise and sunlight, roughly: the noise of a dark pixel."""
    return 30.0**2 + seen.view.world.sensor.sun * 0.5
