"""A target whose plane differs from the recorded one."""

from dataclasses import replace
from itertools import product
from typing import Self

import torch
from torch import Tensor

from tofcorr.geometry.rays import tangents
from tofcorr.options import Options
from tofcorr.simulation.effects.base import (
    FIXED_TARGET,
    MEASURED_PLANES,
    Coefficient,
    EffectInputs,
    GeometryEffect,
)
from tofcorr.simulation.hooks import FrameFacts

# Planes whose entries (n, d) differ by less (no unit, metres) are one plane. Set by hand: far above
# rounding in a file, far below any accuracy of a plane.
_SAME_PLANE = 1e-6
# Largest number of planes with an error of their own. Set by hand: each adds three coefficients.
_MOST_PLANES = 4
# How a target moves.
_MOVES = ("drift", "after_1of3", "after_2of3")
# Shares of the recording after which a target has been bumped into (no unit). Set by hand: with a
# drift, steps after each third come near one at any moment.
_BUMPED = (1 / 3, 2 / 3)
# Prior standard deviations of a plane's place and of its moves, metres and radians. Set by hand: a
# plane is off by a centimetre where nobody measured well, and one that was fixed moves by less.
_PLANE_SD, _MOVE_SD = 0.01, 0.003
_OF_PLANE = (("offset_m", "m"), ("lean_x", "rad"), ("lean_y", "rad"))


class TargetRegistrationShape(Options):
    """The recorded planes (nx, ny, nz, d), the point about which they tilt, and when they move.

    Without a duration the target is at rest.
    """

    planes: tuple[tuple[float, float, float, float], ...] = ()
    pivot_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    start_s: float = 0.0
    duration_s: float = 0.0


class TargetRegistrationEffect(GeometryEffect, shape=TargetRegistrationShape):
    r"""An error of each plane's offset and of the two angles of its normal.

    .. math:: n' = \frac{n + a u + b v}{|n + a u + b v|}, \quad d' = d + \delta - (n' - n) \cdot p

    for unit vectors u and v in the plane and the pivot p. If the shape lists no planes, all planes
    have the same error. A target may also move during the recording: delta, a and b then drift, and
    change after a third and two thirds of it, for all planes alike.

    Source: geometry of a plane.
    """

    name = "target_registration"
    summary = "a plane whose position or tilt differs from the recorded one"
    remedy = "tilts to both sides and a laser or tracker reference of the plane"
    needs = (FIXED_TARGET, MEASURED_PLANES)

    @classmethod
    def for_recording(cls, inputs: EffectInputs) -> Self:
        """Give up to four planes of the recording an error of their own."""
        facts = inputs.facts
        planes = torch.cat([facts.normal_world, facts.offset[:, None]], dim=1)
        unique = torch.unique((planes / _SAME_PLANE).round(), dim=0) * _SAME_PLANE
        listed = tuple(tuple(plane) for plane in unique.tolist()) if len(unique) > 1 else ()
        pivot = tuple(inputs.points_world.mean(0).tolist())
        start, end = float(facts.timestamp.min()), float(facts.timestamp.max())
        moves = {"start_s": start, "duration_s": end - start}
        return cls(TargetRegistrationShape(planes=listed[:_MOST_PLANES], pivot_m=pivot, **moves))

    @classmethod
    def terms(cls, shape: TargetRegistrationShape) -> tuple[Coefficient, ...]:
        """Return the errors of offset and two angles for each plane, then how they change."""
        planes = [f"_{number}" for number in range(len(shape.planes))] or [""]
        moves = [f"_{move}" for move in _MOVES] if shape.duration_s > 0 else []
        sizes = dict.fromkeys(planes, _PLANE_SD) | dict.fromkeys(moves, _MOVE_SD)
        every = product(sizes.items(), _OF_PLANE)
        return tuple(Coefficient(f"{of}{suffix}", unit, sd) for (suffix, sd), (of, unit) in every)

    def in_other_recordings(self) -> Self:
        """Return the effect without the moves of the target, which belong to one recording."""
        shape = self.shape.model_copy(update={"duration_s": 0.0})
        return type(self)(shape, self.coefficients[: len(self.terms(shape))])

    def moved(self, facts: FrameFacts, coefficients: Tensor) -> FrameFacts:
        """Return where the target truly is."""
        normal = facts.normal_world
        error = self._shares(facts) @ coefficients.reshape(-1, 3)
        u, v = -tangents(normal).movedim(1, 0)
        leaning = normal + error[:, 1:2] * u + error[:, 2:3] * v
        leaning = leaning / leaning.norm(dim=1, keepdim=True)
        pivot = normal.new_tensor(self.shape.pivot_m)
        shifted = facts.offset + error[:, 0] - ((leaning - normal) * pivot).sum(1)
        return replace(facts, normal_world=leaning, offset=shifted)

    def _shares(self, facts: FrameFacts) -> Tensor:
        """Return how much of each plane's error, then of each move, frames have, shape (F, G)."""
        shape, shares = self.shape, torch.ones_like(facts.offset)[:, None]
        if shape.planes:
            planes = torch.cat([facts.normal_world, facts.offset[:, None]], dim=1)
            own = torch.cdist(planes, planes.new_tensor(shape.planes)).argmin(dim=1)
            shares = torch.nn.functional.one_hot(own, len(shape.planes)).to(facts.offset.dtype)
        if shape.duration_s > 0:
            passed = ((facts.timestamp - shape.start_s) / shape.duration_s).clamp(0.0, 1.0)
            steps = [(passed > share).to(passed.dtype) for share in _BUMPED]
            shares = torch.cat([shares, torch.stack([passed, *steps], dim=1)], dim=1)
        return shares
