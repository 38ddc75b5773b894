"""Light that reaches the target by a wall or the floor."""

import itertools
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import ClassVar, Self

import torch
from torch import Tensor

from tofcorr.geometry.ranges import SPEED_OF_LIGHT
from tofcorr.options import Options
from tofcorr.simulation.effects.base import CatalogueEffect, Coefficient
from tofcorr.simulation.effects.inputs import EffectInputs
from tofcorr.simulation.effects.needs import FIXED_TARGET, FREQUENCY
from tofcorr.simulation.effects.state_inputs import inputs_from_state
from tofcorr.simulation.hooks import FrameState
from tofcorr.simulation.scene import planes_from_world

_SIDES = (("left", 0, -1.0), ("right", 0, 1.0), ("below", 1, -1.0), ("above", 1, 1.0))
# Distance of a surface from the edge of the field of view on the target, in widths of that field.
# Set by hand: a surface close by, and one farther away.
_BEYOND = {"near": 0.05, "far": 0.4}
# Patches of a surface: distance from the target, depth, and position along the edge relative to the
# point of the target, in widths of the field; all of one width. Set by hand: nine patches sum up to
# a smooth surface where it matters, near the target.
_PATCHES = tuple(
    (before, depth, aside)
    for before, depth in ((0.05, 0.1), (0.15, 0.15), (0.4, 0.35))
    for aside in (-0.25, 0.0, 0.25)
)
_WIDTH = 0.25
# Smallest distance to a patch, metres: nearer patches are not point sources. Set by hand.
_NEAREST = 0.05
# Smallest cosine of the incidence angle used (87 degrees; no unit). Set by hand: keeps the ratio to
# the direct light finite.
_LEAST_COSINE = 0.05
# Pixels that are computed at once. Chosen: a dozen arrays of them stay in a cache of 1 MB.
_PIXELS_AT_ONCE = 8192


class MultipathShape(Options):
    """The area of the target that the camera saw."""

    low_xy_m: tuple[float, float] = (-1.0, -1.0)
    high_xy_m: tuple[float, float] = (1.0, 1.0)


@dataclass(frozen=True)
class _Path:
    """Light by one patch relative to the direct light, and half its extra path, metres; (M,)."""

    strength: Tensor
    extra: Tensor


class MultipathEffect(CatalogueEffect):
    r"""A second path over a diffuse surface beside the target.

    .. math:: z' = z \Bigl(1 + \sum_s \rho_s \sum_p \frac{A_p}{\pi}
              \frac{\cos\alpha_p \cos\beta_p \cos\gamma_p}{r_p^2 q_p^2} \frac{d^2}{\cos\theta}
              e^{j \varphi((r_p + q_p - d) / 2)} \Bigr), \quad
              \Delta d = \frac{c}{4 \pi f} \arg (z' \bar z)

    A surface of reflectivity rho stands at right angles to the target, beside the area seen. Its
    patch p of area A has the distance r from the camera and q from the target's point. It is lit at
    the angle alpha, radiates at beta, and its light arrives at gamma. The direct light falls with
    the distance d and the angle theta. The camera always reads too far (Gudmundsson et al. 2007:
    centimetres in corners).
    """

    name = "multipath"
    summary = "light reflected by a wall, a floor or a table beside the target"
    source = "Gudmundsson et al. 2007; Corti et al. 2015; Lambert's law"
    remedy = "move the target within the room, or cover the floor with something black"
    needs = (FREQUENCY, FIXED_TARGET)
    shape_type: ClassVar[type[Options]] = MultipathShape

    @classmethod
    def for_recording(cls, inputs: EffectInputs) -> Self:
        """Place the surfaces at the edges of the area that the camera saw."""
        low, high = inputs.target_xy.amin(0).tolist(), inputs.target_xy.amax(0).tolist()
        return cls(MultipathShape(low_xy_m=(low[0], low[1]), high_xy_m=(high[0], high[1])))

    @classmethod
    def terms(cls, shape: MultipathShape) -> tuple[Coefficient, ...]:
        """Return the reflectivities of the surfaces, two on each side."""
        del shape
        return tuple(
            Coefficient(f"{side}_{place}", "1", 0.5) for side, _, _ in _SIDES for place in _BEYOND
        )

    def shift(self, inputs: EffectInputs, coefficients: Tensor) -> Tensor:
        """Return the error of the phase as distance, shape (M,), metres."""
        straight, across = self._responses(inputs)
        phase = torch.atan2(across @ coefficients, 1 + straight @ coefficients)
        return inputs.metres_per_radian * phase

    def slope(self, inputs: EffectInputs, coefficients: Tensor) -> Tensor:
        """Return the derivative of `shift`: of arg z by the shares in z, shape (M, K)."""
        straight, across = self._responses(inputs)
        real, imaginary = 1 + straight @ coefficients, across @ coefficients
        scale = inputs.metres_per_radian / (real**2 + imaginary**2)
        return (scale * real)[:, None] * across - (scale * imaginary)[:, None] * straight

    def on_signal(self, state: FrameState) -> None:
        """Add the light of the second paths to every harmonic."""
        shape = state.radial_distance.shape
        total = state.signal
        inputs = inputs_from_state(state)
        for reflectivity, corner in zip(self.coefficients, self._corners(inputs), strict=True):
            if reflectivity == 0:
                continue
            for path in corner.paths():
                turn = state.path_phasor(path.extra.reshape(shape))
                total = total + reflectivity * path.strength.reshape(shape) * turn * state.signal
        state.signal = total

    def _responses(self, inputs: EffectInputs) -> Tensor:
        """Return real and imaginary part of each surface's light over the direct, (2, M, K)."""

        def computed() -> Tensor:
            turn = 4 * torch.pi * inputs.known_frequency / SPEED_OF_LIGHT
            sums = [
                torch.cat([_sum(part, turn) for part in corner.split()], dim=1)
                for corner in self._corners(inputs)
            ]
            return torch.stack(sums, dim=-1)

        return inputs.remembered(f"light by surfaces {self.shape}", computed)

    def _corners(self, inputs: EffectInputs) -> "list[_Corner]":
        """Return each surface, with the coordinates of pixels and camera relative to it."""
        low, high = self.shape.low_xy_m, self.shape.high_xy_m
        extent = max(high[0] - low[0], high[1] - low[1])
        camera = _camera_over_target(inputs)[inputs.frame]
        corners = []
        for (_, axis, sign), beyond in itertools.product(_SIDES, _BEYOND.values()):
            edge = high[axis] if sign > 0 else -low[axis]
            corners.append(
                _Corner(
                    extent=extent,
                    wall=edge + beyond * extent,
                    point=(sign * inputs.target_xy[:, axis], inputs.target_xy[:, 1 - axis]),
                    camera=(sign * camera[:, axis], camera[:, 1 - axis], camera[:, 2]),
                    distance=inputs.radial_distance,
                    incidence_cosine=inputs.incidence_cosine,
                )
            )
        return corners


@dataclass(frozen=True)
class _Corner:
    """A surface beside the target; coordinates are across the surface, along it, and up."""

    extent: float
    wall: float
    point: tuple[Tensor, Tensor]
    camera: tuple[Tensor, Tensor, Tensor]
    distance: Tensor
    incidence_cosine: Tensor

    def split(self) -> "Iterator[_Corner]":
        """Yield the surface over some pixels after others, few enough for the caches."""
        for start in range(0, len(self.distance), _PIXELS_AT_ONCE):
            part = slice(start, start + _PIXELS_AT_ONCE)
            across, along = (values[part] for values in self.point)
            x, y, height = (values[part] for values in self.camera)
            yield replace(
                self,
                point=(across, along),
                camera=(x, y, height),
                distance=self.distance[part],
                incidence_cosine=self.incidence_cosine[part],
            )

    def paths(self) -> Iterator[_Path]:
        """Yield the light by each patch."""
        lit = (self.wall - self.camera[0]).clamp(min=0.0)
        away = (self.wall - self.point[0]).clamp(min=0.0)
        direct = self.distance**2 / self.incidence_cosine.clamp(min=_LEAST_COSINE)
        common = (_WIDTH * self.extent**2 / torch.pi) * lit * away * direct
        lit_square, away_square = lit**2, away**2
        for before, depth, aside in _PATCHES:
            # Lengths in widths of the field of view.
            up, beside = before * self.extent, aside * self.extent
            along, height = self.point[1] + beside - self.camera[1], self.camera[2] - up
            first = (lit_square + along**2 + height**2).sqrt().clamp(min=_NEAREST)
            second = (away_square + (beside**2 + up**2)).sqrt().clamp(min=_NEAREST)
            # Three cosines, and the fall of the light on both parts of the path.
            fall = first**3 * second**4
            yield _Path(depth * up * common / fall, (first + second - self.distance) / 2)


def _sum(corner: _Corner, turn: float) -> Tensor:
    """Return the light by all patches, real and imaginary part, (2, M); `turn` radians a metre."""
    straight, across = torch.zeros_like(corner.distance), torch.zeros_like(corner.distance)
    for path in corner.paths():
        angle = turn * path.extra
        straight = straight.addcmul(path.strength, torch.cos(angle))
        across = across.addcmul(path.strength, torch.sin(angle))
    return torch.stack([straight, across])


def _camera_over_target(inputs: EffectInputs) -> Tensor:
    """Return the camera's position in the target's coordinates, height positive, (F, 3), metres."""
    facts = inputs.facts
    camera = (facts.world_from_tool @ inputs.tool_from_camera)[:, :, 3]
    place = (planes_from_world(facts.normal_world, facts.offset) @ camera[:, :, None])[:, :3, 0]
    return torch.cat([place[:, :2], place[:, 2:].abs()], dim=1)
