"""Taps that no longer grow with the light, and the light that reached them."""

from collections.abc import Iterator
from typing import Self

import torch
from torch import Tensor
from torch.nn.functional import conv1d

from tofcorr.geometry.rays import phase_from_radial_distance
from tofcorr.options import Options
from tofcorr.simulation.effects.base import (
    AMPLITUDE,
    FREQUENCY,
    CatalogueEffect,
    Coefficient,
    EffectInputs,
    inner_range,
    phase_difference,
)
from tofcorr.simulation.hooks import FrameState

# Share of the dim pixels whose amplitude per light is above that of white (no unit). Set by hand:
# white is above dark surfaces, below the noise of bright ones.
_ABOVE_WHITE = 0.1
# A pixel may be clipped if its amplitude is at least this share of white's (no unit). Set by hand:
# a clipped tap loses less than three quarters of the amplitude.
_DARKEST_CLIPPED = 0.25


def light_of(inputs: EffectInputs) -> Tensor:
    """Return the amplitude that each pixel would have if no tap clipped, shape (M,), counts.

    Light is proportional to integration time, cosine of incidence and 1 / d^2. The amplitude of
    white per light is estimated from dim pixels, which do not clip. Where white would be brighter
    than anything in the recording, pixels not much darker than white are assumed to be clipped
    white. Where the light itself is known, nothing is estimated.
    """
    return inputs.remembered(_restored) if inputs.light is None else inputs.light


def _restored(inputs: EffectInputs) -> Tensor:
    amplitude, seconds = inputs.known_amplitude, inputs.facts.integration_time
    if seconds is None or not bool(seconds.isfinite().all()):
        return amplitude
    light = inputs.of_frame(seconds) * inputs.incidence_cosine / inputs.radial_distance**2
    dim = light <= light.median()
    white = light * inner_range((amplitude / light)[dim], _ABOVE_WHITE)[1]
    _, brightest = inner_range(amplitude)
    clipped = (white > brightest) & (amplitude > _DARKEST_CLIPPED * white)
    return torch.where(clipped, torch.maximum(amplitude, white), amplitude)


# The effect.


# A phasor below this share of the brightest tap has no phase. Chosen: far above the rounding of
# float64, far below any noise.
_LEAST_LEFT = 1e-9
# Pixels over which the charge falls by e, and how far it is followed. Set by hand: blooming of
# small pixels reaches a few of them.
_LENGTH_PX = 2.0
_REACH_PX = 4
# Shares of charge that spill: along columns and along rows.
_SPILLS = 2


class SaturationShape(Options):
    """Levels of a tap, in counts, above which its response bends, and the softness of the bend.

    `contrast` is the amplitude over the mean of the taps without ambient light. It gives the level
    of the taps if only amplitudes are recorded. `spill_knee` is the level above which charge
    runs into the pixels beside.
    """

    full_counts: float = 8000.0
    knees: tuple[float, ...] = (0.5, 0.6, 0.7, 0.8, 0.9, 1.0)
    spill_knee: float = 0.7
    softness: float = 0.03
    contrast: float = 0.5


class SaturationEffect(CatalogueEffect, shape=SaturationShape):
    r"""Taps that saturate, softly or at a knee, and spill into the pixels beside.

    .. math:: t' = t - \kappa t^3 / t_f^2 - \sum_k h_k\, o_k(t) + \sum_a g_a S_a o(t),
              \quad o_k(t) = s \ln (1 + e^{(t - k t_f) / s})

    S_a spreads what a pixel has too much, o(t) = max(t - k t_f, 0), over its column or row.

    The distance results from four bent taps, t = B + A cos(phi + k pi / 2): the error has four
    periods within the unambiguous range and grows with the amplitude. The recorded amplitude of a
    clipped pixel is too small; `light_of` estimates A.

    Source: four-tap demodulation with a bent characteristic; Lange 2000.
    """

    name = "saturation"
    summary = "taps that bend or clip in bright pixels"
    remedy = "a bright target at three integration times, one of them short"
    needs = (AMPLITUDE, FREQUENCY)
    reads_light = True
    prior_soft = 0.3

    @classmethod
    def for_recording(cls, inputs: EffectInputs) -> Self:
        """Take the brightest tap of the recording, A + A / contrast, as the full level."""
        full = (1 + 1 / SaturationShape().contrast) * inner_range(inputs.known_amplitude)[1]
        full += float(_ambient(inputs).max())
        return cls(SaturationShape(full_counts=full or 1.0))

    @classmethod
    def terms(cls, shape: SaturationShape) -> tuple[Coefficient, ...]:
        """Return the strength of the soft bend and of every knee, then the shares that spill."""
        knees = [Coefficient(f"knee_{knee:g}", "1", 0.5) for knee in shape.knees]
        spills = [Coefficient(f"spill_along_{lines}", "1", 0.5) for lines in ("columns", "rows")]
        return (Coefficient("soft", "1", cls.prior_soft), *knees, *spills)

    def shift(self, inputs: EffectInputs, coefficients: Tensor) -> Tensor:
        """Return the error of the phase of four bent taps, shape (M,), metres."""
        bent = _phasor(self._bend(self._taps(inputs), coefficients))
        spills = coefficients[-_SPILLS:]
        # Finding out how much spills takes as long as all bends.
        if spills.requires_grad or bool(spills.any()):
            bent = bent + self._spills_of(inputs) @ spills.to(bent.dtype)
        return inputs.metres_per_radian * phase_difference(bent, inputs.turn)

    def columns(self, inputs: EffectInputs) -> Tensor:
        """Return the shift per unit of each coefficient at full strength, shape (M, K), metres.

        The shift of a clipped tap is strongly non-linear. So the columns are chords from 0 to
        h = 1, not the tangents that `slope` gives.
        """
        taps = self._taps(inputs)
        lower = [*map(_phasor, self._bends(taps)), *(-self._spills_of(inputs)).unbind(-1)]
        chords = []
        for number, bend in enumerate(lower):
            strength = 1.0 if number else self.prior_soft / 3
            bent = _phasor(taps) - strength * bend
            # Four taps beyond the knee are all equal: what is left has no phase but rounding's.
            left = bent.abs() > _LEAST_LEFT * taps.amax(0)
            angle = torch.where(left, phase_difference(bent, inputs.turn), 0.0)
            chords.append(angle * (inputs.metres_per_radian / strength))
        return torch.stack(chords, dim=-1)

    def on_taps(self, state: FrameState) -> None:
        """Bend the four taps."""
        counts = state.taps / state.electrons_per_count
        bent = self._bend(counts, self.coefficients)
        for share, axis in zip(self.coefficients[-_SPILLS:], (-2, -1), strict=True):
            if share != 0:
                bent = bent + share * spilled(_over(counts, self.shape), axis)
        state.taps = bent * state.electrons_per_count

    def _taps(self, inputs: EffectInputs) -> Tensor:
        """Return the four taps as they would be without a bend, shape (4, M), counts."""
        amplitude = light_of(inputs)
        background = amplitude / self.shape.contrast + inputs.of_frame(_ambient(inputs))
        return _four_taps(background, amplitude * inputs.turn)

    def _bend(self, taps: Tensor, coefficients: Tensor) -> Tensor:
        bent = taps
        for strength, bend in zip(coefficients[:-_SPILLS], self._bends(taps), strict=True):
            bent = torch.addcmul(bent, -strength.to(bend), bend)
        return bent

    def _bends(self, taps: Tensor) -> Iterator[Tensor]:
        """Yield by how much a soft bend, then each knee, lowers the taps at a strength of 1."""
        full = self.shape.full_counts
        yield taps**3 / full**2
        soft = self.shape.softness * full
        for knee in self.shape.knees:
            yield torch.nn.functional.softplus(taps - knee * full, beta=1 / soft)

    def _spills_of(self, inputs: EffectInputs) -> Tensor:
        """Return the phasors of what runs into the chosen pixels, shape (M, 2), counts."""
        frequency, ambient = inputs.known_frequency, _ambient(inputs)
        found = inputs.from_images(_spilled, frequency, self.shape, of_frames=ambient)
        return found.to(inputs.turn)


def _ambient(inputs: EffectInputs) -> Tensor:
    """Return the background light of the frames, shape (F,), counts; none where it is unknown."""
    ambient = inputs.facts.ambient
    return torch.zeros_like(inputs.facts.offset) if ambient is None else ambient.nan_to_num(0.0)


def _spilled(
    amplitude: Tensor, distance: Tensor, ambient: Tensor, frequency: float, shape: SaturationShape
) -> Tensor:
    """Return the phasors of what runs into each pixel of images, (B, H, W, 2), counts."""
    background = amplitude / shape.contrast + ambient[:, None, None].to(amplitude.dtype)
    if not bool(_over(background + amplitude, shape).any()):  # No tap is brighter.
        return amplitude.new_zeros(*amplitude.shape, _SPILLS)
    phase = phase_from_radial_distance(distance, frequency)
    taps = _four_taps(background, torch.polar(amplitude, phase))
    over = _phasor(_over(taps, shape))
    return torch.stack([spilled(over, axis) for axis in (-2, -1)], dim=-1)


def _over(taps: Tensor, shape: SaturationShape) -> Tensor:
    """Return the charge that runs into the pixels beside."""
    return (taps - shape.spill_knee * shape.full_counts).clamp(min=0.0)


def _four_taps(background: Tensor, signal: Tensor) -> Tensor:
    """Return the four taps, shape (4, ...), of a phasor (...)."""
    cosine, sine = signal.real, signal.imag
    return background + torch.stack([cosine, -sine, -cosine, sine])


def _phasor(taps: Tensor) -> Tensor:
    """Return the phasor that the differences of opposite taps (4, ...) make, complex (...)."""
    return torch.complex(taps[0] - taps[2], taps[3] - taps[1])


def spilled(over: Tensor, axis: int) -> Tensor:
    """Return the charge that each pixel receives from the others on its line, like `over`.

    A pixel gives all that it has too much to its neighbours, equally to both sides and falling by
    e over two pixels. What would run beyond the edge of the image is lost.

    Args:
        over: Charge above the full level, of any shape, not negative.
        axis: The axis along which it runs.
    """
    place = torch.arange(-_REACH_PX, _REACH_PX + 1, device=over.device).abs()
    weights = torch.exp(-place / _LENGTH_PX) * (place > 0)
    lines = over.movedim(axis, -1)
    alone = lines.reshape(-1, 1, lines.shape[-1])
    received = conv1d(alone, (weights / weights.sum()).to(over)[None, None], padding=_REACH_PX)
    return received.reshape(lines.shape).movedim(-1, axis)
