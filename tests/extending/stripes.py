# tofcorr/simulation/effects/stripes.py
"""A pattern of stripes over the image, which a diagnosis can tell from all base errors."""

import torch
from torch import Tensor

from tofcorr.options import Options
from tofcorr.simulation.effects.base import Coefficient, EffectInputs, LinearDelay


class StripesEffect(LinearDelay):
    """Stripes of six periods from the left to the right edge."""

    name = "stripes"
    summary = "stripes over the image"
    remedy = "a white wall"

    @classmethod
    def terms(cls, shape: Options) -> tuple[Coefficient, ...]:
        return (Coefficient("height_m", "m", 0.01),)

    def columns(self, inputs: EffectInputs) -> Tensor:
        return torch.cos(6 * torch.pi * inputs.columns)[:, None]
