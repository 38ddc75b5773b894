"""Shift caused by background light."""

import torch
from torch import Tensor

from tofcorr.options import Options
from tofcorr.simulation.effects.base import (
    AMBIENT,
    AMPLITUDE,
    EffectInputs,
    LinearDelay,
    known,
    terms_in,
)


class AmbientLightShape(Options):
    """The background light that serves as unit."""

    reference_counts: float = 100.0


_WAVES = [f"{kind}_{wave}" for kind in ("false", "returned") for wave in ("cosine", "sine")]


class AmbientLightEffect(LinearDelay, shape=AmbientLightShape):
    r"""Background light that the suppression does not remove completely.

    .. math:: \Delta d = k_1 \frac{B}{A + B} + k_2 \frac{B}{B_0} + k_3 \ln \frac{A + B}{A}
              + \frac{B}{A} (p \cos\varphi + q \sin\varphi)
              + \frac{B d^2}{B_0 \cos\theta} (u \cos\varphi + v \sin\varphi)

    for amplitude A, background B, phase phi, distance d in metres and angle of incidence theta.
    Light without phase information shifts the operating point of the pixel. Taps of unequal
    sensitivity measure a share of it as a signal of fixed phase. If the background is the same for
    all pixels, this error grows with B / A. If the target reflects the background, reflectivity
    cancels in the ratio, and the error grows with d^2 / cos(theta).

    Source: Kahlmann et al. 2006 (background illumination).
    """

    name = "ambient_light"
    summary = "shift by background light"
    remedy = "the same poses with a lamp on and off, the background recorded"
    needs = (AMBIENT, AMPLITUDE)
    fixed_terms = terms_in("m", dict.fromkeys(("share", "linear", "logarithm", *_WAVES), 0.03))

    @classmethod
    def for_recording(cls, inputs: EffectInputs) -> "AmbientLightEffect":
        """Take the strongest background as unit."""
        strongest = float(known(inputs.facts, "ambient").max())
        return cls(AmbientLightShape(reference_counts=strongest or 1.0))

    def columns(self, inputs: EffectInputs) -> Tensor:
        """Return share, background, logarithm and false signals, shape (M, 7)."""
        background = inputs.of_frame(known(inputs.facts, "ambient"))
        amplitude = inputs.known_amplitude.clamp(min=self.shape.reference_counts / 1000)
        share = background / (amplitude + background)
        linear = background / self.shape.reference_counts
        ratio = background / amplitude
        returned = linear * inputs.radial_distance**2 / inputs.incidence_cosine
        known_phase = inputs.modulation_frequency is not None
        phase = inputs.phase if known_phase else torch.zeros_like(ratio)
        waves = phase.cos(), phase.sin()
        false = [weight * wave for weight in (ratio, returned) for wave in waves]
        return torch.stack([share, linear, (1 + ratio).log(), *false], dim=-1)
