"""Effects of geometry: the depth is right, but the pose, ray or plane that is stated is not."""

import numpy as np

from benchmarks.withheld.generator.effect import Effect
from benchmarks.withheld.generator.observe import View
from benchmarks.withheld.generator.rigid import Array, small_motions


def lens(rng: np.random.Generator) -> Effect:
    """The true lens: another focal length and aspect, a division model, shear and a thin prism."""
    focal, aspect, division, shear = rng.normal(0, [0.3, 0.2, 1.0, 0.2])
    prism = rng.normal(0, 0.2, 2)

    def change(strength: float, view: View, slopes: Array) -> Array:
        x, y = slopes
        square = x * x + y * y
        scale = 1 + strength * (focal + division * square / (1 + 0.5 * square))
        along = x * scale * (1 + strength * aspect) + strength * (shear * y + prism[0] * square)
        return np.stack([along, y * scale + strength * prism[1] * square])

    return Effect("lens", "rays", change, 0.03)


def target_shape(rng: np.random.Generator) -> Effect:
    """A board that sags between its supports and has dents."""
    supports, centres = rng.uniform(0.35, 0.6, 2), rng.uniform(-0.45, 0.45, (3, 2))
    widths, depths = rng.uniform(0.12, 0.3, 3), rng.choice([-1, 1], 3) * rng.uniform(0.5, 1.0, 3)

    def change(strength: float, view: View, height: Array) -> Array:
        x, y = view.x, view.y
        shape = np.cosh(x / supports[0]) - 1 + 0.3 * np.cos(np.pi * y / supports[1])
        for (cx, cy), width, depth in zip(centres, widths, depths, strict=True):
            shape = shape + depth * np.exp(-((x - cx) ** 2 + (y - cy) ** 2) / (2 * width**2))
        return height + strength * np.clip(shape, -3, 3)

    return Effect("target_shape", "relief", change, 0.005)


def target_registration(rng: np.random.Generator) -> Effect:
    """The target stands a little off and turned against where it was surveyed."""
    turn, shift = rng.normal(0, 1.0, 2), rng.normal(0, 0.3)

    def change(strength: float, view: View, world_from_target: Array) -> Array:
        miss = small_motions(
            strength * np.array([0.0, 0.0, shift]), strength * np.array([*turn, 0.0])
        )
        return world_from_target @ miss

    return Effect("target_registration", "plane", change, 0.01)


def robot_kinematics(rng: np.random.Generator) -> Effect:
    """An arm that sags with its reach, an eccentric base encoder, a link of another length."""
    sag, eccentric, link = rng.normal(0, [1.0, 1.0, 0.6])
    start = rng.uniform(0, 2 * np.pi)

    def change(strength: float, view: View, world_from_tool: Array) -> Array:
        position = world_from_tool[:, :3, 3]
        reach, azimuth = (
            np.hypot(position[:, 0], position[:, 1]),
            np.arctan2(position[:, 1], position[:, 0]),
        )
        droop = strength * sag * reach**2
        base = strength * eccentric * np.sin(3 * azimuth + start)
        zero = np.zeros_like(reach)
        bend = small_motions(
            np.zeros((len(reach), 3)),
            np.stack([-droop * np.sin(azimuth), droop * np.cos(azimuth), base], -1),
        )
        stretch = (
            strength * link * np.stack([reach * np.cos(azimuth), reach * np.sin(azimuth), zero], -1)
        )
        moved = bend @ world_from_tool
        moved[:, :3, 3] += stretch
        return moved

    return Effect("robot_kinematics", "poses", change, 0.005)


def timestamp_offset(rng: np.random.Generator) -> Effect:
    """Images and poses carry the stamps of two clocks."""
    sign = rng.choice([-1.0, 1.0])

    def change(strength: float, view: View, world_from_tool: Array) -> Array:
        return view.world.world_from_tool(sign * strength)

    return Effect("timestamp_offset", "poses", change, 0.02)
