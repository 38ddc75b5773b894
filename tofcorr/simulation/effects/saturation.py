"""Taps that no longer grow with the light."""

from collections.abc import Iterator
from typing import ClassVar, Self

import torch
from torch import Tensor

from tofcorr.options import Options
from tofcorr.simulation.effects.base import CatalogueEffect, Coefficient
from tofcorr.simulation.effects.inputs import EffectInputs
from tofcorr.simulation.effects.needs import AMPLITUDE, FREQUENCY
from tofcorr.simulation.hooks import FrameState

# Strength of the soft bend at which its chord is taken (no unit). Set by hand: a third of its
# prior's standard deviation.
_SOFT_CHORD = 0.1
# A phasor below this share of the brightest tap has no phase. Chosen: far above the rounding of
# float64, far below any noise.
_LEAST_LEFT = 1e-9
# Quantile of amplitude per light that is taken as white (no unit). Set by hand: above dark
# surfaces, below the noise of bright ones.
_WHITE = 0.9
# A pixel may be clipped if its amplitude is at least this share of white's (no unit). Set by hand:
# a clipped tap loses less than three quarters of the amplitude.
_DARKEST_CLIPPED = 0.25


class SaturationShape(Options):
    """Levels of a tap, in counts, above which its response bends, and the softness of the bend.

    `contrast` is the amplitude over the mean of the taps without ambient light. It gives the level
    of the taps if only amplitudes are recorded.
    """

    full_counts: float = 8000.0
    knees: tuple[float, ...] = (0.5, 0.6, 0.7, 0.8, 0.9, 1.0)
    softness: float = 0.03
    contrast: float = 0.5


class SaturationEffect(CatalogueEffect):
    r"""Taps that saturate, softly or at a knee.

    .. math:: t' = t - \kappa t^3 / t_f^2 - \sum_k h_k\, s \ln (1 + e^{(t - k t_f) / s})

    The distance results from four bent taps, t = B + A cos(phi + k pi / 2): the error has four
    periods within the unambiguous range and grows with the amplitude. The recorded amplitude of a
    clipped pixel is too small; `light_of` estimates A.
    """

    name = "saturation"
    summary = "taps that bend or clip in bright pixels"
    source = "four-tap demodulation with a bent characteristic; Lange 2000"
    remedy = "a bright target at three integration times, one of them short"
    needs = (AMPLITUDE, FREQUENCY)
    form_error = 1.0
    shape_type: ClassVar[type[Options]] = SaturationShape
    in_few_images = True
    reads_light = True

    @classmethod
    def for_recording(cls, inputs: EffectInputs) -> Self:
        """Take the brightest tap of the recording, A + A / contrast, as the full level."""
        extra = 0.0 if inputs.facts.ambient is None else _most(inputs.facts.ambient)
        shape = SaturationShape()
        brightest = _brightest(inputs.known_amplitude)
        full = (1 + 1 / shape.contrast) * brightest + extra
        return cls(SaturationShape(full_counts=max(full, 1e-6)))

    @classmethod
    def terms(cls, shape: SaturationShape) -> tuple[Coefficient, ...]:
        """Return the strength of the soft bend, then of every knee."""
        knees = [Coefficient(f"knee_{knee:g}", "1", 0.5) for knee in shape.knees]
        return (Coefficient("soft", "1", 0.3), *knees)

    def shift(self, inputs: EffectInputs, coefficients: Tensor) -> Tensor:
        """Return the error of the phase of four bent taps, shape (M,), metres."""
        real, imaginary = self._turned(self._bend(self._taps(inputs), coefficients), inputs)
        return inputs.metres_per_radian * torch.atan2(imaginary, real)

    def slope(self, inputs: EffectInputs, coefficients: Tensor) -> Tensor:
        """Return the derivative of `shift`: of arg z by the bends in z, shape (M, K)."""
        taps = self._taps(inputs)
        bends = [self._turned(bend, inputs) for bend in self._bends(taps)]
        real, imaginary = self._turned(taps, inputs)
        for strength, (straight, across) in zip(coefficients, bends, strict=True):
            real, imaginary = real - strength * straight, imaginary - strength * across
        scale = inputs.metres_per_radian / (real**2 + imaginary**2)
        real, imaginary = scale * real, scale * imaginary
        return torch.stack([imaginary * x - real * y for x, y in bends], dim=-1)

    def columns(self, inputs: EffectInputs) -> Tensor:
        """Return the shift per unit of each coefficient at full strength, shape (M, K), metres.

        The shift of a clipped tap is strongly non-linear. So the columns are chords from 0 to
        h = 1, not the tangents that `slope` gives.
        """
        taps = self._taps(inputs)
        chords = []
        for number, bend in enumerate(self._bends(taps)):
            strength = 1.0 if number else _SOFT_CHORD
            real, imaginary = self._turned(taps - strength * bend, inputs)
            # Four taps beyond the knee are all equal: what is left has no phase but rounding's.
            left = torch.hypot(real, imaginary) > _LEAST_LEFT * taps.amax(0)
            angle = torch.where(left, torch.atan2(imaginary, real), 0.0)
            chords.append(angle * (inputs.metres_per_radian / strength))
        return torch.stack(chords, dim=-1)

    def _taps(self, inputs: EffectInputs) -> Tensor:
        """Return the four taps as they would be without a bend, shape (4, M), counts."""
        amplitude, phase = light_of(inputs), inputs.phase
        background = amplitude / self.shape.contrast
        if inputs.facts.ambient is not None:
            background = background + inputs.of_frame(inputs.facts.ambient.nan_to_num(0.0))
        cosine, sine = amplitude * torch.cos(phase), amplitude * torch.sin(phase)
        return torch.stack(
            [background + cosine, background - sine, background - cosine, background + sine]
        )

    @staticmethod
    def _turned(taps: Tensor, inputs: EffectInputs) -> tuple[Tensor, Tensor]:
        """Return real and imaginary part of the phasor of taps, the phase taken off: (M,) each."""
        straight, across = taps[0] - taps[2], taps[3] - taps[1]
        cosine, sine = torch.cos(inputs.phase), torch.sin(inputs.phase)
        return straight * cosine + across * sine, across * cosine - straight * sine

    def on_taps(self, state: FrameState) -> None:
        """Bend the four taps."""
        counts = state.taps / state.electrons_per_count
        state.taps = self._bend(counts, self.coefficients) * state.electrons_per_count

    def _bend(self, taps: Tensor, coefficients: Tensor) -> Tensor:
        bent = taps
        for strength, bend in zip(coefficients, self._bends(taps), strict=True):
            bent = torch.addcmul(bent, strength, bend, value=-1.0)
        return bent

    def _bends(self, taps: Tensor) -> Iterator[Tensor]:
        """Yield by how much a soft bend, then each knee, lowers the taps at a strength of 1."""
        full = self.shape.full_counts
        yield taps**3 / full**2
        soft = self.shape.softness * full
        for knee in self.shape.knees:
            yield torch.nn.functional.softplus(taps - knee * full, beta=1 / soft)


def light_of(inputs: EffectInputs) -> Tensor:
    """Return the amplitude that each pixel would have if no tap clipped, shape (M,), counts.

    Light is proportional to integration time, cosine of incidence and 1 / d^2. The amplitude of
    white per light is estimated from dim pixels, which do not clip. Where white would be brighter
    than anything in the recording, pixels not much darker than white are assumed to be clipped
    white. Where the light itself is known, nothing is estimated.
    """
    if inputs.light is not None:
        return inputs.light
    return inputs.remembered("light without saturation", lambda: _restored(inputs))


def _restored(inputs: EffectInputs) -> Tensor:
    amplitude, seconds = inputs.known_amplitude, inputs.facts.integration_time
    if seconds is None or not bool(seconds.isfinite().all()):
        return amplitude
    light = inputs.of_frame(seconds) * inputs.incidence_cosine / inputs.radial_distance**2
    dim = light <= light.median()
    white = light * _quantile((amplitude / light)[dim], _WHITE)
    clipped = (white > _brightest(amplitude)) & (amplitude > _DARKEST_CLIPPED * white)
    return torch.where(clipped, torch.maximum(amplitude, white), amplitude)


def _brightest(amplitude: Tensor) -> float:
    return _quantile(amplitude, 0.999)


def _quantile(values: Tensor, share: float) -> float:
    return float(values.sort().values[int(share * (len(values) - 1))])


def _most(values: Tensor) -> float:
    return float(values.nan_to_num(0.0).max())
