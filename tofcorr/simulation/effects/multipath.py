"""Light that reaches the target by a wall or the floor."""

import itertools
from dataclasses import dataclass
from typing import ClassVar, Self

import torch
from torch import Tensor

from tofcorr.geometry.ranges import phase_from_radial_distance
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
        factor = 1 + self._responses(inputs) @ coefficients.to(torch.complex128)
        return inputs.metres_per_radian * factor.angle()

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
        """Return each surface's light relative to the direct light, shape (M, K), complex128."""
        return inputs.remembered(
            f"light by surfaces {self.shape}",
            lambda: torch.stack([_sum(corner, inputs) for corner in self._corners(inputs)], dim=-1),
        )

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

    def paths(self) -> list[_Path]:
        """Return the light by each patch."""
        return [self._path(*patch) for patch in _PATCHES]

    def _path(self, before: float, depth: float, aside: float) -> _Path:
        """Return the light by one patch; lengths are in widths of the field of view."""
        before, aside = before * self.extent, aside * self.extent
        lit = (self.wall - self.camera[0]).clamp(min=0.0)
        along, up = self.point[1] + aside - self.camera[1], self.camera[2] - before
        first = (lit**2 + along**2 + up**2).sqrt().clamp(min=_NEAREST)
        away = (self.wall - self.point[0]).clamp(min=0.0)
        second = (away**2 + aside**2 + before**2).sqrt().clamp(min=_NEAREST)
        cosines = (lit / first) * (away / second) * (before / second)
        direct = self.distance**2 / self.incidence_cosine.clamp(min=_LEAST_COSINE)
        area = depth * _WIDTH * self.extent**2
        strength = area * cosines * direct / (torch.pi * first**2 * second**2)
        return _Path(strength, (first + second - self.distance) / 2)


def _sum(corner: _Corner, inputs: EffectInputs) -> Tensor:
    """Return the phasor of all paths by a surface, shape (M,), complex128."""
    paths = corner.paths()
    turns = [phase_from_radial_distance(path.extra, inputs.known_frequency) for path in paths]
    strengths = [path.strength for path in paths]
    return torch.polar(torch.stack(strengths), torch.stack(turns)).sum(0)


def _camera_over_target(inputs: EffectInputs) -> Tensor:
    """Return the camera's position in the target's coordinates, height positive, (F, 3), metres."""
    facts = inputs.facts
    camera = (facts.world_from_tool @ inputs.tool_from_camera)[:, :, 3]
    place = (planes_from_world(facts.normal_world, facts.offset) @ camera[:, :, None])[:, :3, 0]
    return torch.cat([place[:, :2], place[:, 2:].abs()], dim=1)
