"""Circular error of a signal that is not a pure sine."""

import torch
from torch import Tensor

from tofcorr.geometry.ranges import unambiguous_range
from tofcorr.options import Options
from tofcorr.simulation.effects.base import CatalogueEffect, Coefficient
from tofcorr.simulation.effects.inputs import EffectInputs
from tofcorr.simulation.effects.needs import FREQUENCY
from tofcorr.simulation.hooks import FrameState

# Periods of the error within the unambiguous range. The harmonic of order n + 1 of the light causes
# n of them.
_CYCLES = (4, 8, 12)


class WigglingEffect(CatalogueEffect):
    r"""Odd harmonics of the light, which four taps cannot separate from the fundamental.

    .. math:: \Delta d = \frac{c}{4 \pi f} \arg \Bigl(1 + \sum_{n = 4, 8, 12}
              \rho_n e^{j (n \varphi + \psi_n)} \Bigr)

    Four samples alias the harmonic of order n + 1 onto the fundamental, so the error repeats with a
    quarter of the unambiguous range. Coefficients are the amplitudes of sin and cos in
    metres, (c / 4 pi f) rho cos psi and (c / 4 pi f) rho sin psi.
    """

    name = "wiggling"
    summary = "periodic error of the distance, from harmonics of the light"
    source = "Lindner and Kolb 2006; Drayton et al. 2013"
    remedy = "many distances over one and a half periods of the error (a quarter of c / 2f each)"
    needs = (FREQUENCY,)

    @classmethod
    def terms(cls, shape: Options) -> tuple[Coefficient, ...]:
        """Return sine and cosine of each number of periods."""
        del shape
        return tuple(
            Coefficient(f"{wave}_{cycles}", "m", 0.08 / cycles)
            for cycles in _CYCLES
            for wave in ("sin", "cos")
        )

    def shift(self, inputs: EffectInputs, coefficients: Tensor) -> Tensor:
        """Return the error of the phase as distance, shape (M,), metres."""
        scale = inputs.metres_per_radian
        total = torch.ones_like(inputs.phase).to(torch.complex128)
        for number, cycles in enumerate(_CYCLES):
            share = torch.complex(coefficients[2 * number], coefficients[2 * number + 1]) / scale
            cycle = torch.polar(torch.ones_like(inputs.phase), cycles * inputs.phase)
            total = total + share * cycle
        return scale * total.angle()

    def on_signal(self, state: FrameState) -> None:
        """Add the harmonics of order n + 1 to the light."""
        scale = unambiguous_range(state.modulation_frequency) / (2 * torch.pi)
        for number, cycles in enumerate(_CYCLES):
            sine, cosine = self.coefficients[2 * number], self.coefficients[2 * number + 1]
            if sine == 0 and cosine == 0:
                continue
            share = torch.complex(sine, cosine) / scale
            fundamental = state.signal[0]
            turn = fundamental / fundamental.abs().clamp(min=1e-30)
            _add_harmonic(state, cycles + 1, share * fundamental * turn**cycles)


def _add_harmonic(state: FrameState, order: int, phasor: Tensor) -> None:
    place = torch.nonzero(state.orders == order).reshape(-1)
    if len(place):
        signal = state.signal.clone()
        signal[place[0]] += phasor
        state.signal = signal
        return
    state.orders = torch.cat([state.orders, state.orders.new_tensor([order])])
    state.signal = torch.cat([state.signal, phasor[None]])
