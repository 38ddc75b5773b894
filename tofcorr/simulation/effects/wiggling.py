"""Circular error of a signal that is not a pure sine."""

import math
from itertools import product
from typing import Self

import torch
from torch import Tensor

from tofcorr.options import Options
from tofcorr.simulation.effects.base import (
    FREQUENCY,
    Coefficient,
    EffectInputs,
    SignalEffect,
    inner_range,
    inputs_from_state,
    side_by_side,
    terms_in,
)
from tofcorr.simulation.hooks import FrameState

# Periods of the error within the unambiguous range: multiples of the first. The harmonic of order
# n + 1 of the light causes n of them.
_CYCLES = (4, 8, 12)
# Share of the amplitudes, at either end, beyond which the error changes no more. Chosen.
_BEYOND = 0.02


class WigglingShape(Options):
    """The range of amplitudes over which the error changes; none: it does not change."""

    low_counts: float = 0.0
    high_counts: float = 0.0

    @property
    def knows_amplitude(self) -> bool:
        """Whether there is a range."""
        return self.high_counts > self.low_counts > 0


class WigglingEffect(SignalEffect, shape=WigglingShape):
    r"""Odd harmonics of the light, which four taps cannot separate from the fundamental.

    .. math:: \Delta d = \frac{c}{4 \pi f} \arg \Bigl(1 + \sum_{n = 4, 8, 12}
              \rho_n e^{j (n \varphi + \psi_n)} + u \, \rho' e^{j (4 \varphi + \psi')} \Bigr)

    Four samples alias the harmonic of order n + 1 onto the fundamental, so the error repeats with a
    quarter of the unambiguous range. Coefficients are the amplitudes of sin and cos in
    metres, (c / 4 pi f) rho cos psi and (c / 4 pi f) rho sin psi. Where the amplitude is known, the
    error may change with it: u is its logarithm scaled to [-1, 1] (Lefloch et al. 2013).

    Source: Lindner and Kolb 2006; Drayton et al. 2013; Lefloch et al. 2013.
    """

    name = "wiggling"
    summary = "periodic error of the distance, from harmonics of the light"
    remedy = "many distances over one and a half periods of the error (a quarter of c / 2f each)"
    needs = (FREQUENCY,)
    prior = 0.08

    @classmethod
    def for_recording(cls, inputs: EffectInputs) -> Self:
        """Take the range of most amplitudes, where they are known."""
        amplitude = inputs.amplitude
        if amplitude is None or not bool((amplitude > 0).any()):
            return cls(WigglingShape())
        low, high = inner_range(amplitude[amplitude > 0], _BEYOND)
        return cls(WigglingShape(low_counts=low, high_counts=high))

    @classmethod
    def terms(cls, shape: WigglingShape) -> tuple[Coefficient, ...]:
        """Return sine and cosine of each number of periods, then their change with amplitude."""
        ranks = {f"_{cycles}": cycles for cycles in _CYCLES}
        if shape.knows_amplitude:
            ranks[f"_{_CYCLES[0]}_amplitude"] = 2 * _CYCLES[0]
        both = product(ranks.items(), ("sin", "cos"))
        return terms_in("m", {f"{wave}{name}": cls.prior / rank for (name, rank), wave in both})

    def shares(self, inputs: EffectInputs) -> Tensor:
        """Return sine and cosine of each number of periods: its wave, and that a quarter on."""
        waves = [wave / inputs.metres_per_radian for wave in self._waves(inputs.turn, inputs)]
        return side_by_side([share for wave in waves for share in (wave, 1j * wave)])

    def on_signal(self, state: FrameState) -> None:
        """Add the harmonics of order n + 1 to the light."""
        inputs, fundamental = inputs_from_state(state), state.signal[0]
        waves = self._waves(fundamental.sgn(), inputs)
        orders = [*(cycles + 1 for cycles in _CYCLES), _CYCLES[0] + 1]
        pairs = self.coefficients.reshape(-1, 2).unbind(0)
        for (sine, cosine), order, own in zip(pairs, orders, waves, strict=False):
            if sine == 0 and cosine == 0:
                continue
            phasor = torch.complex(sine, cosine) / inputs.metres_per_radian * fundamental * own
            state.orders = torch.cat([state.orders, state.orders.new_tensor([order])])
            state.signal = torch.cat([state.signal, phasor[None]])

    def _waves(self, turn: Tensor, inputs: EffectInputs) -> list[Tensor]:
        """Return e^(j n phase) for each number of periods, then the first one times u."""
        # Products: a power takes torch 60 times as long.
        first = turn.square().square()
        waves = [first, first.square(), first.square() * first]
        if self.shape.knows_amplitude and inputs.amplitude is not None:
            ends = self.shape.low_counts, self.shape.high_counts
            low, high = map(math.log, ends)
            level = 2 * (inputs.amplitude.clamp(*ends).log() - low) / (high - low) - 1
            waves.append(level.reshape(first.shape) * first)
        elif self.shape.knows_amplitude:
            waves.append(torch.zeros_like(first))
        return waves
