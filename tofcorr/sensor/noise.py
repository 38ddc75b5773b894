"""The noise of a sensor: standard deviation, correlation of neighbours, and draws."""

import math

import torch
from torch import Tensor, nn

from tofcorr.sensor.pixel_sections import NoiseSection

# Half width of the filter in its standard deviations: 0.006 % of a Gaussian lies beyond 4.
_REACH = 4.0


class SensorNoise(nn.Module):
    r"""Noise along the ray, :math:`\sigma(A) \epsilon`.

    .. math:: \sigma^2 = f^2 + s^2 \frac{A_0}{A} + r^2 \left(\frac{A_0}{A}\right)^2

    with :math:`\epsilon` of variance 1, correlated between neighbours; a share of its variance is
    the same in every frame. Differentiable in f, s, r, distance and amplitude.

    Args:
        section: The numbers.
        size: Height and width of the image.

    Attributes:
        deviations: f, s and r, shape (3,), metres; any sign.
    """

    fixed: Tensor
    kernel: Tensor

    def __init__(self, section: NoiseSection, size: tuple[int, int]) -> None:
        super().__init__()
        self.section = section
        numbers = [section.floor_m, section.shot_m, section.read_m]
        self.deviations = nn.Parameter(torch.tensor(numbers, dtype=torch.float64))
        kernel = _kernel(section.correlation_px)
        self.register_buffer("kernel", kernel)
        camera = torch.Generator().manual_seed(section.fixed_seed)
        reach = kernel.numel() // 2
        padded = (size[0] + 2 * reach, size[1] + 2 * reach)
        drawn = torch.randn(padded, generator=camera, dtype=torch.float64)
        self.register_buffer("fixed", self._filtered(drawn[None])[0])

    @property
    def needs_amplitude(self) -> bool:
        """Whether the noise depends on the amplitude."""
        return self.section.reference_amplitude is not None

    def sigma(self, distance: Tensor, amplitude: Tensor) -> Tensor:
        """Return the standard deviation along the ray, shape (...), metres.

        Args:
            distance: Along the ray, shape (...), metres; read only without a reference amplitude.
            amplitude: The camera's units, shape (...); read only with one.
        """
        reference = self.section.reference_amplitude
        if reference is None:
            brightness = (self.section.reference_distance_m / distance).square()
        else:
            brightness = amplitude / reference
        darkness = 1.0 / brightness.clamp(min=self.section.least_brightness)
        floor, shot, read = self.deviations.square().unbind()
        return (floor + darkness * (shot + read * darkness)).sqrt()

    def draw(self, like: Tensor, generator: torch.Generator | None) -> Tensor:
        """Draw noise of standard deviation 1, shape (..., H, W), dtype and device of `like`."""
        share = self.section.fixed_share
        reach = self.kernel.numel() // 2
        height, width = like.shape[-2:]
        size = (like[..., 0, 0].numel(), height + 2 * reach, width + 2 * reach)
        drawn = torch.randn(size, generator=generator, dtype=like.dtype, device=like.device)
        noise = self._filtered(drawn).reshape(like.shape)
        if share == 0:
            return noise
        return math.sqrt(1 - share) * noise + math.sqrt(share) * self.fixed.to(like.dtype)

    def to_section(self) -> NoiseSection:
        """Return the numbers of now."""
        floor, shot, read = self.deviations.detach().abs().tolist()
        return self.section.model_copy(update={"floor_m": floor, "shot_m": shot, "read_m": read})

    def _filtered(self, drawn: Tensor) -> Tensor:
        """Correlate neighbours of white images (B, H + 2 reach, W + 2 reach); (B, H, W).

        Sums of shifted images: on a processor faster than a convolution with one channel.
        """
        if self.kernel.numel() == 1:
            return drawn
        reach = self.kernel.numel() // 2
        *outer, middle = self.kernel[: reach + 1].tolist()
        for axis in (1, 2):
            count = drawn.shape[axis] - 2 * reach
            filtered = middle * drawn.narrow(axis, reach, count)
            for place, weight in enumerate(outer):
                pair = drawn.narrow(axis, place, count) + drawn.narrow(
                    axis, 2 * reach - place, count
                )
                filtered = torch.add(filtered, pair, alpha=weight)
            drawn = filtered
        return drawn


def _kernel(width_px: float) -> Tensor:
    """Return the weights of a Gaussian filter that keeps the variance of white noise, (2r + 1,)."""
    if width_px <= 0:
        return torch.ones(1, dtype=torch.float64)
    reach = max(1, math.ceil(_REACH * width_px))
    at = torch.arange(-reach, reach + 1, dtype=torch.float64)
    weights = torch.exp(-0.5 * (at / width_px) ** 2)
    return weights / weights.square().sum().sqrt()
