"""Light that reaches the target by a wall or the floor."""

from typing import ClassVar, Self

import torch
from torch import Tensor

from tofcorr.geometry.ranges import SPEED_OF_LIGHT
from tofcorr.options import Options
from tofcorr.simulation.effects.base import CatalogueEffect, Coefficient
from tofcorr.simulation.effects.indirect_light import BEYOND, SIDES, light_by_surfaces
from tofcorr.simulation.effects.inputs import EffectInputs
from tofcorr.simulation.effects.needs import FIXED_TARGET, FREQUENCY
from tofcorr.simulation.effects.polynomials import exponents, products
from tofcorr.simulation.effects.smooth_over_target import Seen, in_every_pixel
from tofcorr.simulation.effects.state_inputs import inputs_from_state
from tofcorr.simulation.hooks import FrameState

# Degree over the target of the light of the room. Chosen: what many bounces light is smooth.
_ROOM_DEGREE = 2
# Smallest cosine of the incidence angle used (87 degrees; no unit). Set by hand: keeps the ratio to
# the direct light finite.
_LEAST_COSINE = 0.05


class MultipathShape(Options):
    """The area of the target that the camera saw, and the distance from which it did."""

    low_xy_m: tuple[float, float] = (-1.0, -1.0)
    high_xy_m: tuple[float, float] = (1.0, 1.0)
    distance_m: float = 1.0


class MultipathEffect(CatalogueEffect):
    r"""Light by other ways than the direct one, in three forms that add up.

    .. math:: z' = z \Bigl(1 + \sum_s \rho_s a_s + j \frac{4 \pi f}{c} R
              + \kappa \frac{D_0^2}{d^2} \cos\theta \, e^{j \varphi(d)} \Bigr), \quad
              \Delta d = \frac{c}{4 \pi f} \arg (z' \bar z)

    *Surfaces.* A diffuse surface of reflectivity rho stands at right angles to the target, beside
    the area seen. The light by its patches p, of area A, at the distances r from the camera and q
    from the target's point, is relative to the direct light

    .. math:: a_s = \sum_p \frac{A_p}{\pi} \frac{\cos\alpha_p \cos\beta_p \cos\gamma_p}{r_p^2 q_p^2}
              \frac{d^2}{\cos\theta} e^{j \varphi((r_p + q_p - d) / 2)} .

    A patch is lit at the angle alpha, radiates at beta, and its light arrives at gamma. The direct
    light falls with the distance d and the angle theta. *Room.* What bounced more often lights the
    target evenly, whatever the room looks like. Its error grows as the direct light falls,

    .. math:: R = \frac{d^2}{D_0^2 \cos\theta}
              \sum_{i+j \le 2} (u_{ij} + v_{ij} (d / D_0 - 1)) P_i(x) P_j(y) ,

    with the mean distance D_0 of the recording. *Flange.* What holds the camera sends the light of
    the target back to it. In corners the camera reads centimetres too far (Gudmundsson et al.
    2007).
    """

    name = "multipath"
    summary = "light reflected by a wall, a floor or a table beside the target"
    source = "Gudmundsson et al. 2007; Corti et al. 2015; Lambert's law"
    remedy = "move the target within the room, or cover the floor with something black"
    needs = (FREQUENCY, FIXED_TARGET)
    form_error = 1.0
    shape_type: ClassVar[type[Options]] = MultipathShape

    @classmethod
    def for_recording(cls, inputs: EffectInputs) -> Self:
        """Place the surfaces at the edges of the area that the camera saw."""
        low, high = inputs.target_xy.amin(0).tolist(), inputs.target_xy.amax(0).tolist()
        distance = float(inputs.radial_distance.mean())
        shape = MultipathShape(
            low_xy_m=(low[0], low[1]), high_xy_m=(high[0], high[1]), distance_m=distance
        )
        return cls(shape)

    @classmethod
    def terms(cls, shape: MultipathShape) -> tuple[Coefficient, ...]:
        """Return the reflectivities, the light of the room, and that of the flange."""
        del shape
        places = [f"{side}_{place}" for side, _, _ in SIDES for place in BEYOND]
        room = exponents(0, _ROOM_DEGREE)
        return (
            *(Coefficient(place, "1", 0.5) for place in places),
            *(
                Coefficient(f"room_x{i}_y{j}{suffix}", "m", 0.03 / (1 + i + j))
                for suffix in ("", "_distance")
                for i, j in room
            ),
            Coefficient("flange", "1", 0.05),
        )

    def shift(self, inputs: EffectInputs, coefficients: Tensor) -> Tensor:
        """Return the error of the phase as distance, shape (M,), metres."""
        straight, across = self._responses(inputs)
        phase = torch.atan2(across @ coefficients, 1 + straight @ coefficients)
        return inputs.metres_per_radian * phase

    def slope(self, inputs: EffectInputs, coefficients: Tensor) -> Tensor:
        """Return the derivative of `shift`: of arg z by the shares in z, shape (M, K)."""
        if not bool(coefficients.any()):
            return inputs.metres_per_radian * self._response(inputs, 1, "imaginary")
        straight, across = self._responses(inputs)
        real, imaginary = 1 + straight @ coefficients, across @ coefficients
        scale = inputs.metres_per_radian / (real**2 + imaginary**2)
        return (scale * real)[:, None] * across - (scale * imaginary)[:, None] * straight

    def on_signal(self, state: FrameState) -> None:
        """Add the light of the other ways to every harmonic."""
        if not bool(self.coefficients.any()):
            return
        inputs = inputs_from_state(state)
        shares = []
        for order in state.orders.tolist():
            parts = [
                self._response(inputs, order, part) @ self.coefficients
                for part in ("real", "imaginary")
            ]
            shares.append(torch.complex(*parts).reshape(state.radial_distance.shape))
        state.signal = state.signal * (1 + torch.stack(shares))

    def _responses(self, inputs: EffectInputs) -> tuple[Tensor, Tensor]:
        """Return real and imaginary part of each coefficient's light, each (M, K)."""
        return self._response(inputs, 1, "real"), self._response(inputs, 1, "imaginary")

    def _response(self, inputs: EffectInputs, order: int, part: str) -> Tensor:
        """Return one part of each coefficient's light over the direct light, (M, K)."""
        shape = self.shape
        area = shape.low_xy_m, shape.high_xy_m
        count = len(SIDES) * len(BEYOND)
        turn = order * 4 * torch.pi * inputs.known_frequency / SPEED_OF_LIGHT

        def surfaces(seen: Seen) -> Tensor:
            light = light_by_surfaces(seen, area, turn)
            return light.real if part == "real" else light.imag

        def computed() -> Tensor:
            flange = self._flange(inputs, turn, part)[:, None]
            room = turn * self._room(inputs)
            room = torch.zeros_like(room) if part == "real" else room
            return torch.cat([in_every_pixel(surfaces, inputs, count), room, flange], dim=1)

        return inputs.remembered(f"{part} light of order {order} by {shape}", computed)

    def _room(self, inputs: EffectInputs) -> Tensor:
        """Return the error by the light of the room for each coefficient, (M, 12), metres."""
        shape = self.shape
        low, high = (inputs.target_xy.new_tensor(v) for v in (shape.low_xy_m, shape.high_xy_m))
        x, y = (2 * (inputs.target_xy - low) / (high - low) - 1).clamp(-1.0, 1.0).unbind(-1)
        far = inputs.radial_distance / shape.distance_m
        strength = far**2 / inputs.incidence_cosine.clamp(min=_LEAST_COSINE)
        smooth = strength[:, None] * products(x, y, 0, _ROOM_DEGREE)
        return torch.cat([smooth, (far - 1)[:, None] * smooth], dim=1)

    def _flange(self, inputs: EffectInputs, turn: float, part: str) -> Tensor:
        """Return one part of the light that went there and back twice, (M,)."""
        phase = turn * inputs.radial_distance
        wave = torch.cos(phase) if part == "real" else torch.sin(phase)
        return (self.shape.distance_m / inputs.radial_distance) ** 2 * (
            inputs.incidence_cosine * wave
        )
