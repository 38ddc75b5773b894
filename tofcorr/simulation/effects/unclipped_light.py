"""The light that reached pixels whose recorded amplitude is too small because a tap clipped."""

import torch
from torch import Tensor

from tofcorr.simulation.effects.inputs import EffectInputs

# Quantile of amplitude per light that is taken as white (no unit). Set by hand: above dark
# surfaces, below the noise of bright ones.
_WHITE = 0.9
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
    clipped = (white > brightest(amplitude)) & (amplitude > _DARKEST_CLIPPED * white)
    return torch.where(clipped, torch.maximum(amplitude, white), amplitude)


def brightest(amplitude: Tensor) -> float:
    """Return the amplitude that hardly a pixel exceeds."""
    return _quantile(amplitude, 0.999)


def _quantile(values: Tensor, share: float) -> float:
    return float(values.sort().values[int(share * (len(values) - 1))])
