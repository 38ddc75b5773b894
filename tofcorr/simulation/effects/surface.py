"""How a surface returns light: shifts with the angle at which the ray meets it."""

import torch
from torch import Tensor

from tofcorr.options import Options
from tofcorr.simulation.effects.base import Coefficient, EffectInputs, LinearDelay

LEAST_COSINE = 0.05
"""Smallest cosine used (87 degrees; no unit). Set by hand: 1 / cosine stays finite, and no camera
measures at that angle."""


class IncidenceAngleEffect(LinearDelay):
    r"""A shift with the angle between ray and surface.

    .. math:: \Delta d = k_1 (1 / \cos \theta - 1) + k_2 (1 - \cos \theta)^2

    Depending on the material, light of a slanted ray travels farther inside it, or less deep.

    Source: Radmer et al. 2008 (incident light).
    """

    name = "incidence_angle"
    summary = "shift with the angle at which the ray meets the surface"
    remedy = "tilts to both sides at one distance, and a second material"
    fixed_terms = (Coefficient("secant", "m", 0.1), Coefficient("square", "m", 0.1))

    def columns(self, inputs: EffectInputs) -> Tensor:
        """Return the two functions of the angle, shape (M, 2)."""
        cosine = inputs.incidence_cosine.clamp(min=LEAST_COSINE)
        return torch.stack([1 / cosine - 1, (1 - cosine) ** 2], dim=-1)


class GlossShape(Options):
    """Widths of the highlight, degrees of the angle of incidence."""

    width_deg: tuple[float, ...] = (4.0, 8.0, 16.0)


class GlossEffect(LinearDelay, shape=GlossShape):
    r"""A shift of the pixels that look straight at the target.

    .. math:: \Delta d = \sum_w g_w \, e^{-2 (1 - \cos\theta) / w^2}
              \approx \sum_w g_w \, e^{-\theta^2 / w^2}

    The lamp stands beside the lens, so a glossy surface mirrors it where the ray meets the surface
    at a right angle. Light that is mirrored has not walked inside the material, and reads nearer
    than the rest; light that was mirrored to a wall and back reads farther. The lobe of a real
    surface is a sum of narrow and wide ones. The brightness of the highlight is not simulated.

    Source: specular lobe (Torrance and Sparrow 1967) beside subsurface delay.
    """

    name = "gloss"
    summary = "highlights of a glossy target, where the camera looks straight at it"
    remedy = "the same poses with a matt target, or tilted by more than the highlight's width"

    @classmethod
    def terms(cls, shape: GlossShape) -> tuple[Coefficient, ...]:
        """Return the shift at the middle of each lobe: plastics delay light by millimetres."""
        return tuple(Coefficient(f"lobe_{width:g}deg", "m", cls.prior) for width in shape.width_deg)

    def columns(self, inputs: EffectInputs) -> Tensor:
        """Return the lobes, shape (M, K)."""
        width = torch.deg2rad(inputs.incidence_cosine.new_tensor(self.shape.width_deg))
        return torch.exp(-2 * (1 - inputs.incidence_cosine)[:, None] / width**2)
