"""Shift with the angle of incidence: light enters the surface before it returns."""

import torch
from torch import Tensor

from tofcorr.simulation.effects.base import Coefficient, LinearDelay
from tofcorr.simulation.effects.inputs import EffectInputs

# Smallest cosine used (87 degrees; no unit). Set by hand: 1 / cosine stays finite, and no camera
# measures at that angle.
_LEAST_COSINE = 0.05


class IncidenceAngleEffect(LinearDelay):
    r"""A shift with the angle between ray and surface.

    .. math:: \Delta d = k_1 (1 / \cos \theta - 1) + k_2 (1 - \cos \theta)^2

    Depending on the material, light of a slanted ray travels farther inside it, or less deep.
    """

    name = "incidence_angle"
    summary = "shift with the angle at which the ray meets the surface"
    source = "Radmer et al. 2008 (incident light)"
    remedy = "tilts to both sides at one distance, and a second material"
    fixed_terms = (Coefficient("secant", "m", 0.1), Coefficient("square", "m", 0.1))

    def columns(self, inputs: EffectInputs) -> Tensor:
        """Return the two functions of the angle, shape (M, 2)."""
        cosine = inputs.incidence_cosine.clamp(min=_LEAST_COSINE)
        return torch.stack([1 / cosine - 1, (1 - cosine) ** 2], dim=-1)
