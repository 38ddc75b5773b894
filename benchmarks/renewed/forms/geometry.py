"""Forms of what is wrong with the lens, the target, and where the target is said to stand."""

import numpy as np

from benchmarks.renewed.geometry import Array, Random, small_motions
from benchmarks.renewed.signal_chain import Change, View, adding, form
from benchmarks.renewed.world import World

STEEP = float(np.deg2rad(35.0))


@form("lens", "rays", 0.03, textbook=True, tilt=STEEP)
def barrel(rng: Random, world: World) -> Change:
    """The true radial distortion is another."""
    sign = rng.choice([-1.0, 1.0])
    return lambda strength, view, slopes: slopes * (1 + sign * strength * (slopes**2).sum(0))


@form("lens", "rays", 0.01, tilt=STEEP)
def focus(rng: Random, world: World) -> Change:
    """Refocused after the calibration: another focal length and principal point."""
    scale, shift = rng.choice([-1.0, 1.0]) * rng.uniform(0.5, 1), rng.normal(0, 0.3, 2)
    return lambda strength, view, slopes: (
        slopes * (1 + strength * scale) + strength * shift[:, None, None]
    )


@form("lens", "rays", 0.03, tilt=STEEP)
def tilted_sensor(rng: Random, world: World) -> Change:
    """The sensor does not stand square to the axis: a perspective change of the image."""
    along = rng.normal(0, 1, 2)
    return lambda strength, view, slopes: (
        slopes / (1 + strength * np.einsum("i,ihw->hw", along, slopes))
    )


@form("target_shape", "relief", 0.005, textbook=True)
def bow(rng: Random, world: World) -> Change:
    """A bowed sheet: a cylinder across some direction."""
    angle, size = rng.uniform(0, np.pi), _size(world)

    return adding(lambda view: np.minimum((_across(view, angle) / size) ** 2, 6.0))


@form("target_shape", "relief", 0.005)
def bumps(rng: Random, world: World) -> Change:
    """A plastered wall: bumps and hollows of a hand's breadth."""
    size = _size(world)
    centres, widths = rng.uniform(-0.7, 0.7, (14, 2)) * size, rng.uniform(0.1, 0.25, 14) * size
    heights = rng.choice([-1.0, 1.0], 14) * rng.uniform(0.4, 1.0, 14)

    def change(strength: float, view: View, height: Array) -> Array:
        for (cx, cy), width, size_of in zip(centres, widths, heights, strict=True):
            square = ((view.x - cx) ** 2 + (view.y - cy) ** 2) / width**2
            height = height + strength * size_of * np.exp(-square / 2)
        return height

    return change


@form("target_shape", "relief", 0.005)
def panels(rng: Random, world: World) -> Change:
    """Two sheets that meet in a joint: a step and a kink."""
    angle, at, size = rng.uniform(0, np.pi), rng.uniform(-0.2, 0.2), _size(world)
    step, kink = rng.normal(0, 1, 2)

    def relief(view: View) -> Array:
        across = _across(view, angle) / size - at
        return step * (across > 0) + 2 * kink * np.clip(across, 0, 2)

    return adding(relief)


def _across(view: View, angle: float) -> Array:
    """Metres on the target in a direction, at every pixel."""
    return np.cos(angle) * view.x + np.sin(angle) * view.y


@form("target_registration", "plane", 0.005, textbook=True)
def misplaced(rng: Random, world: World) -> Change:
    """The target stands turned and shifted against its survey."""
    turn, shift = rng.normal(0, 1, 2) / _size(world), rng.normal(0, 0.5)
    return _leaning(turn, shift)


@form("target_registration", "plane", 0.005)
def bumped(rng: Random, world: World) -> Change:
    """Somebody bumped into the target during the recording."""
    turn, shift = rng.normal(0, 1, 2) / _size(world), rng.normal(0, 0.7)
    after = np.arange(world.frames) >= world.frames * rng.uniform(0.25, 0.75)
    after = after[world.way.pose_id.searchsorted(world.way.pose_id)]  # a pose is of one side
    return _leaning(turn, shift, after.astype(np.float64)[:, None])


@form("target_registration", "plane", 0.005)
def sinking(rng: Random, world: World) -> Change:
    """The stand gives way slowly: the target leans more and more."""
    turn, when = rng.normal(0, 1, 2) / _size(world), world.way.seconds / world.way.seconds[-1]
    return _leaning(turn, 0.0, when[:, None])


def _leaning(turn: Array, shift: float, share: Array | float = 1.0) -> Change:
    """The target turned about its axes and shifted along its normal, by a share in every frame."""
    place, leaning = np.array([0, 0, shift]), np.array([*turn, 0])
    return lambda strength, view, plane: (
        plane @ small_motions(strength * share * place, strength * share * leaning)
    )


def _size(world: World) -> float:
    """Half the width (metres) of what the camera sees at the middle distance."""
    lens = world.sensor.lens
    return float(np.sqrt(world.design.near * world.design.far) * lens.width / lens.focal[0] / 2)
