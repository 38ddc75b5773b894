"""Light scattered inside the lens."""

from collections.abc import Callable
from functools import cache, partial

import torch
from kornia.geometry.transform import warp_affine
from torch import Tensor

from tofcorr.geometry.camera import CameraIntrinsics
from tofcorr.options import Options
from tofcorr.simulation.effects.base import (
    AMPLITUDE,
    FREQUENCY,
    Coefficient,
    EffectInputs,
    SignalEffect,
    blur,
)
from tofcorr.simulation.hooks import FrameState


class StrayLightShape(Options):
    """Widths of the scattered light, as shares of the image width, and ghosts.

    A ghost is as large as its share of the image. A size between two of these is close to both:
    what they show at their edges lies less than a tenth of the image width apart.
    """

    sigma_of_width: tuple[float, ...] = (0.05, 0.12, 0.3)
    ghost_sizes: tuple[float, ...] = (0.5, 0.6, 0.72, 0.86, 1.0)
    ghost_sigma_of_width: float = 0.02


class StrayLightEffect(SignalEffect, shape=StrayLightShape):
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

    Source: Kavli et al. 2008; Mure-Dubois and Huegli 2007.
    """

    name = "stray_light"
    summary = "light scattered inside the lens, visible in dark pixels next to bright ones"
    remedy = "the same pose with and without a bright object near the camera"
    needs = (AMPLITUDE, FREQUENCY)

    @classmethod
    def terms(cls, shape: StrayLightShape) -> tuple[Coefficient, ...]:
        """Return the share of the light scattered by each width, over the image, and in ghosts."""
        widths = [Coefficient(f"share_{sigma:g}", "1", 0.5) for sigma in shape.sigma_of_width]
        ghosts = [Coefficient(f"ghost_{size:g}", "1", 0.1) for size in shape.ghost_sizes]
        return (*widths, Coefficient("veil", "1", 0.2), *ghosts)

    def shares(self, inputs: EffectInputs) -> Tensor:
        """Return the scattered light over the direct light; none where there is no light."""
        scattered = inputs.from_signal(_scattered, inputs.camera, self.shape)
        own = inputs.signal()[:, None]
        return scattered * torch.where(own == 0, 0, 1 / own)

    def on_signal(self, state: FrameState) -> None:
        """Scatter the light of every harmonic."""
        chosen = self.coefficients.nonzero()[:, 0]
        if len(chosen):
            ways = _scattered(state.signal, state.camera, self.shape, tuple(chosen.tolist()))
            state.signal = state.signal + ways @ self.coefficients[chosen].to(ways)


def _scattered(
    signal: Tensor, camera: CameraIntrinsics, shape: StrayLightShape, chosen: tuple[int, ...] = ()
) -> Tensor:
    """Return the light that some coefficients add to phasor images, shape (B, H, W, K); (): all."""
    ways: list[Callable[[], Tensor]] = []
    ways += [partial(blur, signal, sigma * camera.width) for sigma in shape.sigma_of_width]
    ways.append(lambda: signal.mean((1, 2), keepdim=True).expand_as(signal))
    out_of_focus = cache(partial(blur, signal, shape.ghost_sigma_of_width * camera.width))
    ways += [lambda size=size: ghost(out_of_focus(), camera, size) for size in shape.ghost_sizes]
    return torch.stack([ways[number]() for number in chosen or range(len(ways))], dim=-1)


def ghost(images: Tensor, camera: CameraIntrinsics, size: float) -> Tensor:
    """Return complex images (F, H, W) turned half round about the optical axis and made smaller.

    Outside the ghost, and where it shows what the image does not hold, it is dark.

    Args:
        images: Phasors.
        camera: Where the optical axis meets the image.
        size: Of the ghost, over that of the image.
    """
    parts, ((_, _, x), (_, _, y), _) = torch.view_as_real(images).movedim(-1, 1), camera.matrix
    turn = parts.new_tensor([[-size, 0.0, (1 + size) * x], [0.0, -size, (1 + size) * y]])
    turn, shape = turn.expand(len(parts), 2, 3), (camera.height, camera.width)
    turned = warp_affine(parts, turn, shape, align_corners=True)
    return torch.view_as_complex(turned.movedim(1, -1).contiguous())
