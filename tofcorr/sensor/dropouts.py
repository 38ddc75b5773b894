"""Pixels without a distance: how probable they are, and draws."""

import torch
from torch import Tensor, nn

from tofcorr.sensor.pixel_sections import DropoutSection

# Darkest amplitude as a share of that at half (no unit), so that its logarithm is finite: there
# every pixel is missing. Chosen.
_DARKEST = 1e-6


class SensorDropouts(nn.Module):
    r"""Which pixels the camera gives no distance for.

    .. math:: P = b + (1 - b) / (1 + (A / A_{1/2})^{1/w})

    A draw has no gradient, so these numbers are not parameters; `probability` is differentiable in
    the amplitude.

    Args:
        section: The numbers.
    """

    def __init__(self, section: DropoutSection) -> None:
        super().__init__()
        self.section = section

    @property
    def needs_amplitude(self) -> bool:
        """Whether anything depends on the amplitude."""
        return not (self.section.amplitude_at_half is self.section.saturation_amplitude is None)

    def probability(self, amplitude: Tensor) -> Tensor:
        """Return the probability that a pixel of this amplitude is missing, shape (...)."""
        section = self.section
        share = torch.full_like(amplitude, section.base_share)
        if section.amplitude_at_half is not None:
            # A logistic function of ln A.
            relative = (amplitude / section.amplitude_at_half).clamp(min=_DARKEST)
            dark = torch.sigmoid(relative.log() / -section.width)
            share = section.base_share + (1 - section.base_share) * dark
        if section.saturated_share is not None:
            share = torch.where(self.saturated(amplitude), section.saturated_share, share)
        return share

    def draw(self, amplitude: Tensor, generator: torch.Generator | None) -> Tensor:
        """Draw which pixels have a distance, bool, shape (...)."""
        probability = self.probability(amplitude.detach())
        drawn = torch.rand(
            amplitude.shape, generator=generator, dtype=amplitude.dtype, device=amplitude.device
        )
        return drawn >= probability

    def saturated(self, amplitude: Tensor) -> Tensor:
        """Return where a pixel is saturated, bool, shape (...)."""
        level = self.section.saturation_amplitude
        if level is None:
            return torch.zeros_like(amplitude, dtype=torch.bool)
        return amplitude >= level

    def reported(self, amplitude: Tensor) -> Tensor:
        """Return the amplitude that the camera states: none above saturation."""
        level = self.section.saturation_amplitude
        if level is None:
            return amplitude
        # float16 ends at 65504, below the level of a camera that counts to 65535.
        return amplitude.clamp(max=min(level, torch.finfo(amplitude.dtype).max))
