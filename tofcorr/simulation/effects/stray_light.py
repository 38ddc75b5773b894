"""Light scattered inside the lens."""

from typing import ClassVar

from torch import Tensor

from tofcorr.options import Options
from tofcorr.simulation.effects.base import CatalogueEffect, Coefficient
from tofcorr.simulation.effects.blur import blur
from tofcorr.simulation.effects.derivative import phase_difference
from tofcorr.simulation.effects.inputs import EffectInputs
from tofcorr.simulation.effects.needs import AMPLITUDE, FREQUENCY
from tofcorr.simulation.hooks import FrameState


class StrayLightShape(Options):
    """Widths of the scattered light, as shares of the image width."""

    sigma_of_width: tuple[float, ...] = (0.05, 0.12, 0.3)


class StrayLightEffect(CatalogueEffect):
    r"""Every pixel receives some light of its neighbourhood.

    .. math:: z' = z + \sum_s w_s G_s * z + w_\infty \langle z \rangle, \quad
              \Delta d = \frac{c}{4 \pi f} \arg (z' \bar z)

    with the phasor z = A exp(j phi): dark pixels are shifted towards the distance of bright ones.
    The lens spreads light over a neighbourhood, a dirty cover glass over the whole image. Such a
    model can remove more than 60 % of the error (Kavli et al. 2008).
    """

    name = "stray_light"
    summary = "light scattered inside the lens, visible in dark pixels next to bright ones"
    source = "Kavli et al. 2008"
    remedy = "the same pose with and without a bright object near the camera"
    needs = (AMPLITUDE, FREQUENCY)
    form_error = 1.0
    shape_type: ClassVar[type[Options]] = StrayLightShape

    @classmethod
    def terms(cls, shape: StrayLightShape) -> tuple[Coefficient, ...]:
        """Return the share of the light that is scattered by each width, and over the image."""
        widths = [Coefficient(f"share_{sigma:g}", "1", 0.5) for sigma in shape.sigma_of_width]
        return (*widths, Coefficient("veil", "1", 0.2))

    def shift(self, inputs: EffectInputs, coefficients: Tensor) -> Tensor:
        """Return the error of the phase as distance, shape (M,), metres."""
        own = inputs.signal()
        total = own
        *shares, veil = coefficients.unbind(0)
        for share, sigma in zip(shares, self._widths(inputs.camera.width), strict=True):
            total = total + share * inputs.blurred_signal(sigma)
        total = total + veil * inputs.mean_signal()
        return inputs.metres_per_radian * phase_difference(total, own)

    def on_signal(self, state: FrameState) -> None:
        """Scatter the light of every harmonic."""
        total = state.signal
        *shares, veil = self.coefficients.unbind(0)
        for share, sigma in zip(shares, self._widths(state.camera.width), strict=True):
            if share != 0:
                total = total + share * blur(state.signal, sigma)
        state.signal = total + veil * state.signal.mean((1, 2), keepdim=True)

    def _widths(self, image_width: int) -> list[float]:
        shape = self.shape
        return [sigma * image_width for sigma in shape.sigma_of_width]
