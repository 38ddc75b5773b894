r"""How uncertain a distance is after second bounces were removed.

Four independent parts, standard deviations along the ray:

* the gain: :math:`\delta \, \sigma_s / s`, of what was removed, :math:`\delta`;
* the planes: twice what a further round would change, since the distances that were found give the
  next planes;
* twice the distance of the result from those planes, averaged over 5 x 5 cells: light that is
  missing, from beyond the image as well, bends what is flat;
* hidden surfaces: light by way of the backs of the patches, as bright as their fronts. All of it
  counts, for nobody knows what the backs are like.
"""

import torch
from torch import Tensor, nn

from tofcorr.scene_light.bounces import SecondBounces, SecondBouncesState, turned

_TWICE = 2.0
"""Errors over what they show: the change of a further round, and bent planes. Set on
`benchmarks/scene_light/uncertainty.py`, building seeds: 2.1 and 2.2."""
_NORMAL_95 = 3.92
"""Width of an interval of 95 % in standard deviations."""


class UnremovedBounces(nn.Module):
    """Standard deviation of what second bounces still add to a distance, or lack.

    Args:
        bounces: What removes them.
        state: Of the same, with the interval of the gain.
    """

    def __init__(self, bounces: SecondBounces, state: SecondBouncesState) -> None:
        super().__init__()
        self.bounces = bounces
        self.gain_error: float = 0.0
        if state.gain_interval is not None and state.gain > 0:
            low, high = state.gain_interval
            self.gain_error = (high - low) / (_NORMAL_95 * state.gain)
        self.scale: float = _TWICE

    def forward(self, radial: Tensor, amplitude: Tensor) -> Tensor:
        """Return standard deviations along the ray, metres.

        Args:
            radial: Without the camera's own error, second bounces left in, metres (H, W) or
                (B, H, W).
            amplitude: Measured, the camera's units.
        """
        if radial.dim() == 2:
            return self.of_frame(radial, amplitude)
        found = torch.empty_like(radial)
        for i in range(radial.shape[0]):
            found[i] = self.of_frame(radial[i], amplitude[i])
        return found

    def of_frame(self, radial: Tensor, amplitude: Tensor) -> Tensor:
        """Return `forward` of one frame (H, W)."""
        bounces = self.bounces
        measured, strength = bounces.cells(radial, amplitude)
        shift, used, _ = bounces.found(measured, strength)
        again, _, _ = bounces.found(measured, strength, 3)
        here = measured - shift
        planes, fits, _ = bounces.planes(here)
        off = ((planes * bounces.cell_rays.double()).sum(0) * here - 1.0) * here
        off = off.nan_to_num().reshape(1, bounces.rows, bounces.columns)
        bent = nn.functional.avg_pool2d(off, 5, 1, 2).reshape(-1)
        hidden = self.by_the_backs(planes, fits, strength)
        shown = (again - shift).square() + bent.square()
        variance = self.scale**2 * shown + hidden.square() + (self.gain_error * shift).square()
        return bounces.in_pixels(variance.sqrt(), radial, shift, used)

    def by_the_backs(self, planes: Tensor, fits: Tensor, amplitude: Tensor) -> Tensor:
        """Return what light adds that goes from patches to backs of patches to the cells (N,).

        Args:
            planes: g of the cells (3, N).
            fits: Which of them are on a plane (N,).
            amplitude: Of the cells (N,).
        """
        bounces, waves = self.bounces, self.bounces.wave_numbers
        place, normal, away, cosine, area = bounces.surfaces(
            planes, bounces.cell_rays.double(), bounces.solid.double()
        )
        seen = planes.isfinite().all(0) & amplitude.isfinite() & (cosine > bounces.steepest)
        grey = torch.where(seen, bounces.gain * amplitude * away.square() / cosine, 0.0)
        light = torch.zeros(2, len(waves), place.shape[1]).to(place)
        light[0] = light[0] + torch.where(seen, amplitude * area, 0.0)
        light = turned(light, waves, away.nan_to_num())
        sends = seen & fits
        middle, facing, whole, light = bounces.patches(place, normal, area, light, sends)
        free = torch.ones(whole.shape[0], whole.shape[0]).to(place)
        place, normal = place.nan_to_num(), normal.nan_to_num()
        back = torch.cat([place, -normal])
        back = bounces.gathered(back, middle, facing, whole, light, free) * grey
        back = back * torch.where(sends, area, 0.0)
        _, _, _, light = bounces.patches(place, normal, area, back, sends)
        front = torch.cat([place, normal])
        ratio = bounces.gathered(front, middle, -facing, whole, light, free)
        ratio = turned(ratio, [-k for k in waves], away.nan_to_num())
        scaled = ratio * (bounces.gain * away.square() / cosine)
        return bounces.shift(torch.where(seen, scaled, 0.0))
