"""Taps that no longer grow with the light."""

from typing import ClassVar, Self

import torch
from torch import Tensor

from tofcorr.options import Options
from tofcorr.simulation.effects.base import AMPLITUDE, FREQUENCY, CatalogueEffect, Coefficient
from tofcorr.simulation.effects.inputs import EffectInputs
from tofcorr.simulation.hooks import FrameState

_QUARTER = torch.pi / 2


class SaturationShape(Options):
    """Levels of a tap, in counts, from which it bends; the softness of the bend.

    `contrast` is the amplitude over the mean of the taps without ambient light: it tells the
    level of the taps where only amplitudes are recorded.
    """

    full_counts: float = 8000.0
    knees: tuple[float, ...] = (0.4, 0.6, 0.8)
    softness: float = 0.05
    contrast: float = 0.5


class Saturation(CatalogueEffect):
    r"""Taps that saturate, softly or at a knee.

    .. math:: t' = t - \kappa t^3 / t_f^2 - \sum_k h_k\, s \ln (1 + e^{(t - k t_f) / s})

    The distance comes from four bent taps, t = B + A cos(phi + k pi / 2): the error has four
    periods within the unambiguous range and grows with the amplitude.
    """

    name = "saturation"
    summary = "taps that bend or clip in bright pixels"
    source = "four-tap demodulation with a bent characteristic; Lange 2000"
    remedy = "a bright target at three integration times, one of them short"
    needs = (AMPLITUDE, FREQUENCY)
    shape_type: ClassVar[type[Options]] = SaturationShape

    @classmethod
    def for_recording(cls, inputs: EffectInputs) -> Self:
        """Take the brightest tap of the recording, A + A / contrast, as the full one."""
        bright = inputs.known_amplitude.sort().values
        top = float(bright[int(0.999 * (len(bright) - 1))])
        ambient = inputs.facts.ambient
        extra = 0.0 if ambient is None else float(ambient.nan_to_num(0.0).max())
        return cls(SaturationShape(full_counts=max(3 * top + extra, 1e-6)))

    @classmethod
    def terms(cls, shape: SaturationShape) -> tuple[Coefficient, ...]:
        """Return the strength of the soft bend, then of every knee."""
        knees = [Coefficient(f"knee_{knee:g}", "1", 0.5) for knee in shape.knees]
        return (Coefficient("soft", "1", 0.3), *knees)

    def shift(self, inputs: EffectInputs, coefficients: Tensor) -> Tensor:
        """Return the error of the phase of four bent taps, shape (M,), metres."""
        amplitude, phase = inputs.known_amplitude, inputs.phase
        background = amplitude / self.shape.contrast
        if inputs.facts.ambient is not None:
            background = background + inputs.of_frame(inputs.facts.ambient.nan_to_num(0.0))
        steps = torch.arange(4, dtype=torch.float64)[:, None] * _QUARTER
        taps = self._bend(background + amplitude * torch.cos(phase + steps), coefficients)
        bent = torch.complex(taps[0] - taps[2], taps[3] - taps[1])
        straight = torch.polar(torch.ones_like(phase), phase)
        return inputs.metres_per_radian * (bent * straight.conj()).angle()

    def on_taps(self, state: FrameState) -> None:
        """Bend the four taps."""
        counts = state.taps / state.electrons_per_count
        state.taps = self._bend(counts, self.coefficients) * state.electrons_per_count

    def _bend(self, taps: Tensor, coefficients: Tensor) -> Tensor:
        shape = self.shape
        full = shape.full_counts
        bent = taps - coefficients[0] * taps**3 / full**2
        soft = shape.softness * full
        for strength, knee in zip(coefficients[1:], shape.knees, strict=True):
            excess = torch.nn.functional.softplus((taps - knee * full) / soft) * soft
            bent = bent - strength * excess
        return bent
