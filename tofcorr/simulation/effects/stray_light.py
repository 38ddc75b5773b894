"""Light scattered inside the lens."""

from typing import ClassVar

import torch
from torch import Tensor

from tofcorr.geometry.camera import CameraIntrinsics
from tofcorr.options import Options
from tofcorr.simulation.effects.base import Coefficient, SignalEffect
from tofcorr.simulation.effects.image_filters import blur, ghost
from tofcorr.simulation.effects.inputs import AMPLITUDE, FREQUENCY, EffectInputs, signal_of
from tofcorr.simulation.hooks import FrameState


class StrayLightShape(Options):
    """Widths of the scattered light, as shares of the image width, and ghosts.

    A ghost is as large as its share of the image. A size between two of these is close to both:
    what they show at their edges lies less than a tenth of the image width apart.
    """

    sigma_of_width: tuple[float, ...] = (0.05, 0.12, 0.3)
    ghost_sizes: tuple[float, ...] = (0.5, 0.6, 0.72, 0.86, 1.0)
    ghost_sigma_of_width: float = 0.02


class StrayLightEffect(SignalEffect):
    r"""Every pixel receives some light of its neighbourhood.

    .. math:: z'(u) = z + \sum_s w_s G_s * z + w_\infty \langle z \rangle
              + \sum_m g_m (G_g * z)(-u / m), \quad
              \Delta d = \frac{c}{4 \pi f} \arg (z' \bar z)

    with the phasor z = A exp(j phi): dark pixels are shifted towards the distance of bright ones.
    The lens spreads light over a neighbourhood, a dirty cover glass over the whole image. Such a
    model can remove more than 60 % of the error (Kavli et al. 2008). Light that the sensor throws
    back, and the lens to it again, is a ghost: the image turned half round about the optical axis
    (u = 0), smaller by m and out of focus (G_g). A bright spot is then seen again on the other
    side.
    """

    name = "stray_light"
    summary = "light scattered inside the lens, visible in dark pixels next to bright ones"
    source = "Kavli et al. 2008; Mure-Dubois and Huegli 2007"
    remedy = "the same pose with and without a bright object near the camera"
    needs = (AMPLITUDE, FREQUENCY)
    form_error = 1.0
    shape_type: ClassVar[type[Options]] = StrayLightShape

    @classmethod
    def terms(cls, shape: StrayLightShape) -> tuple[Coefficient, ...]:
        """Return the share of the light scattered by each width, over the image, and in ghosts."""
        widths = [Coefficient(f"share_{sigma:g}", "1", 0.5) for sigma in shape.sigma_of_width]
        ghosts = [Coefficient(f"ghost_{size:g}", "1", 0.1) for size in shape.ghost_sizes]
        return (*widths, Coefficient("veil", "1", 0.2), *ghosts)

    def shares(self, inputs: EffectInputs) -> Tensor:
        """Return the scattered light over the direct light; none where there is no light."""
        spread = [inputs.blurred_signal(sigma) for sigma in self._widths(inputs.camera.width)]
        ghosts = inputs.from_images(_ghosts, inputs.known_frequency, inputs.camera, self.shape)
        scattered = torch.cat([torch.stack([*spread, inputs.mean_signal()], dim=1), ghosts], dim=1)
        own = inputs.signal()[:, None]
        return torch.where(own == 0, 0, scattered / own)

    def on_signal(self, state: FrameState) -> None:
        """Scatter the light of every harmonic."""
        signal, camera, shape = state.signal, state.camera, self.shape
        widths = len(shape.sigma_of_width)
        shares, veil, ghosts = self.coefficients.split([widths, 1, len(shape.ghost_sizes)])
        total = signal + veil * signal.mean((1, 2), keepdim=True)
        for share, sigma in zip(shares, self._widths(camera.width), strict=True):
            if share != 0:
                total = total + share * blur(signal, sigma)
        if bool(ghosts.any()):
            blurred = _out_of_focus(signal, shape)
            for share, size in zip(ghosts, shape.ghost_sizes, strict=True):
                total = total + share * ghost(blurred, camera, size)
        state.signal = total

    def _widths(self, image_width: int) -> list[float]:
        return [sigma * image_width for sigma in self.shape.sigma_of_width]


def _ghosts(
    amplitude: Tensor,
    distance: Tensor,
    frequency: float,
    camera: CameraIntrinsics,
    shape: StrayLightShape,
) -> Tensor:
    """Return the phasor of each ghost of images, shape (B, H, W, G)."""
    blurred = _out_of_focus(signal_of(amplitude, distance, frequency), shape)
    return torch.stack([ghost(blurred, camera, size) for size in shape.ghost_sizes], dim=-1)


def _out_of_focus(signal: Tensor, shape: StrayLightShape) -> Tensor:
    return blur(signal, shape.ghost_sigma_of_width * signal.shape[-1])
