"""Light that reaches the target by way of a wall or the floor."""

from typing import ClassVar, Self

import torch
from torch import Tensor

from tofcorr.geometry.ranges import phase_from_radial_distance
from tofcorr.options import Options
from tofcorr.simulation.effects.base import FIXED_TARGET, FREQUENCY, CatalogueEffect, Coefficient
from tofcorr.simulation.effects.inputs import EffectInputs
from tofcorr.simulation.hooks import FrameState

_SIDES = (("left", 0, -1.0), ("right", 0, 1.0), ("below", 1, -1.0), ("above", 1, 1.0))


class MultipathShape(Options):
    """The part of the target that the camera saw, and how the second light falls off."""

    low_xy_m: tuple[float, float] = (-1.0, -1.0)
    high_xy_m: tuple[float, float] = (1.0, 1.0)
    falloff_m: tuple[float, ...] = (0.25, 0.8)


class Multipath(CatalogueEffect):
    r"""A second path over a surface beside the target.

    .. math:: z' = z \Bigl(1 + \sum_s \rho_s e^{-h_s / \ell} e^{j \varphi(2 h_s)} \Bigr), \quad
              \Delta d = \frac{c}{4 \pi f} \arg (z' \bar z)

    A point at distance h_s from the side s of the field seen gets light over a surface that
    stands there. Its detour is about 2 h_s (half of the extra way: h_s), at least the fall-off
    length, so it always reads too far (Gudmundsson et al. 2007: centimetres in corners).
    """

    name = "multipath"
    summary = "light that comes over a wall, a floor or a table beside the target"
    source = "Gudmundsson et al. 2007; Corti et al. 2015"
    remedy = "move the target within the room, or cover the floor with something black"
    needs = (FREQUENCY, FIXED_TARGET)
    shape_type: ClassVar[type[Options]] = MultipathShape

    @classmethod
    def for_recording(cls, inputs: EffectInputs) -> Self:
        """Let the surfaces stand at the edges of what the camera saw."""
        low, high = inputs.target_xy.amin(0).tolist(), inputs.target_xy.amax(0).tolist()
        extent = max(high[0] - low[0], high[1] - low[1])
        return cls(
            MultipathShape(
                low_xy_m=(low[0], low[1]),
                high_xy_m=(high[0], high[1]),
                falloff_m=(0.12 * extent, 0.35 * extent),
            )
        )

    @classmethod
    def terms(cls, shape: MultipathShape) -> tuple[Coefficient, ...]:
        """Return the relative strength of the second light, one a side and fall-off."""
        return tuple(
            Coefficient(f"{side}_{length}", "1", 0.1)
            for side, _, _ in _SIDES
            for length in ("near", "far", "wide")[: len(shape.falloff_m)]
        )

    def shift(self, inputs: EffectInputs, coefficients: Tensor) -> Tensor:
        """Return the error of the phase as distance, shape (M,), metres."""
        factor = self._factor(inputs.target_xy, coefficients, inputs.known_frequency)
        return inputs.metres_per_radian * factor.angle()

    def on_signal(self, state: FrameState) -> None:
        """Add the second light to every harmonic."""
        shape = state.radial_distance.shape
        total = state.signal
        target_xy = state.target_xy.reshape(-1, 2)
        for strength, (fading, extra) in zip(
            self.coefficients, self._paths(target_xy), strict=True
        ):
            if strength != 0:
                path = state.path_phasor(extra.reshape(shape))
                total = total + strength * fading.reshape(shape) * path * state.signal
        state.signal = total

    def _factor(self, target_xy: Tensor, coefficients: Tensor, frequency: float) -> Tensor:
        total = torch.ones_like(target_xy[:, 0]).to(torch.complex128)
        for strength, (fading, extra) in zip(coefficients, self._paths(target_xy), strict=True):
            total = total + strength * torch.polar(
                fading, phase_from_radial_distance(extra, frequency)
            )
        return total

    def _paths(self, target_xy: Tensor) -> list[tuple[Tensor, Tensor]]:
        """Return fading and half detour of each second path, shapes (M,)."""
        shape = self.shape
        paths = []
        for _, axis, sign in _SIDES:
            edge = shape.high_xy_m[axis] if sign > 0 else shape.low_xy_m[axis]
            away = (sign * (edge - target_xy[:, axis])).clamp(min=0.0)
            paths += [(torch.exp(-away / length), away + length) for length in shape.falloff_m]
        return paths
