r"""Stray light: light that the camera's own lens and sensor send to the wrong pixel, taken back.

A pixel's phasor z = A exp(2 i k r), k = 2 pi f / c, reaches the sensor as

.. math:: z' = z + S z, \quad
          S z = \sum_s w_s G_s * z + w_\infty \langle z \rangle + \sum_m g_m (G_g * z)(-u / m)

with Gaussians G, the mean of the image, and ghosts: the image turned half round about the optical
axis (u = 0), smaller by m and out of focus. `tofcorr diagnose` measures the shares w and g as the
effect `stray_light`. The light is taken back by z <- z' - S z, begun with z = z': each round leaves
the share of stray light times what was left. S is smooth, so it is computed on cells of pixels.

Source: Kavli et al. 2008; Mure-Dubois and Huegli 2007.
"""

import math
from typing import Self

import torch
from pydantic import PositiveFloat, model_validator
from torch import Tensor, nn
from torch.nn.functional import avg_pool2d, interpolate, pad

from tofcorr.geometry.camera import CameraIntrinsics
from tofcorr.geometry.rays import unambiguous_range
from tofcorr.options import Number, Options, PositiveNumber

_LEFT = 2.5e-3
"""Share of the stray light that may be left, and by which averages over cells may widen its
Gaussians. Chosen: of centimetres, hundredths of millimetres."""


class StrayLightState(Options):
    """Where a camera's stray light comes from.

    Attributes:
        modulation_frequency: Hz.
        sigma_of_width: Standard deviations of the Gaussians over the width of the image.
        shares: Share of the light that each of them scatters.
        veil: Share that is scattered over the whole image.
        ghost_sizes: Sizes of ghosts over that of the image.
        ghost_shares: Share of the light in each of them.
        ghost_sigma_of_width: Standard deviation of a ghost's blur over the width of the image.
    """

    modulation_frequency: PositiveNumber
    sigma_of_width: tuple[PositiveFloat, ...] = ()
    shares: tuple[Number, ...] = ()
    veil: Number = 0.0
    ghost_sizes: tuple[PositiveFloat, ...] = ()
    ghost_shares: tuple[Number, ...] = ()
    ghost_sigma_of_width: PositiveFloat = 0.02

    @model_validator(mode="after")
    def _less_than_all(self) -> Self:
        """Refuse more stray light than there is light: taking it back would not end."""
        total = sum(map(abs, (*self.shares, *self.ghost_shares, self.veil)))
        if total >= 1:
            raise ValueError(f"expected 'shares', 'ghost_shares' and 'veil' below 1, got {total:g}")
        return self


class StrayLight(nn.Module):
    """Takes stray light out of single frames.

    Args:
        camera: The intrinsics.
        state: Where the stray light comes from.

    Shape:
        - Input: `(..., H, W)` twice: radial distance, metres; amplitude, any unit.
        - Output: the same. A pixel without a return stays as it is, and sends no light.
    """

    rows: Tensor
    columns: Tensor
    shares: Tensor

    def __init__(self, camera: CameraIntrinsics, state: StrayLightState) -> None:
        super().__init__()
        height, width = camera.height, camera.width
        self.turns_per_metre: float = 2 * math.pi / unambiguous_range(state.modulation_frequency)
        self.height, self.width, self.veil = height, width, float(state.veil)
        ghosts = [state.ghost_sigma_of_width] * len(state.ghost_sizes)
        sigmas = [width * share for share in (*state.sigma_of_width, *ghosts)]
        # The mean over a cell adds its square over 12 to a variance.
        self.cell: int = max(1, int(min(sigmas, default=width) * (24 * _LEFT) ** 0.5))
        (_, _, x), (_, _, y), _ = camera.matrix
        sizes = [*(-1.0 for _ in state.sigma_of_width), *state.ghost_sizes]
        spreads = list(zip(sizes, sigmas, strict=True))
        for name, size, centre in (("rows", height, y), ("columns", width, x)):
            each = [self._spread(size, centre, *spread) for spread in spreads]
            cells = math.ceil(size / self.cell)
            stacked = torch.stack(each) if each else torch.zeros(0, cells, cells)
            self.register_buffer(name, stacked.float())
        shares = [*state.shares, *state.ghost_shares]
        self.register_buffer("shares", torch.tensor(shares, dtype=torch.float32))
        # Each round leaves the share of all stray light of what was left.
        scattered = max(sum(map(abs, [*shares, state.veil])), _LEFT)
        self.rounds: int = math.ceil(math.log(_LEFT) / math.log(scattered))

    def _spread(self, size: int, centre: float, ghost: float, sigma: float) -> Tensor:
        """Return what each cell of a line receives of each, (N, N), edges repeated.

        Args:
            size: Pixels of the line.
            centre: Where the optical axis meets it, pixels.
            ghost: Size of a ghost; -1: none, light is spread about where it belongs.
            sigma: Standard deviation, pixels.
        """
        cells = math.ceil(size / self.cell)
        middle = (torch.arange(cells, dtype=torch.float64) + 0.5) * self.cell - 0.5
        seen = centre - (middle - centre) / ghost
        inner = torch.arange(1, cells, dtype=torch.float64) * self.cell - 0.5
        ends = torch.special.ndtr((inner - seen[:, None]) / sigma)
        share = pad(pad(ends, [0, 1], value=1.0), [1, 0]).diff(dim=1)
        # What a ghost shows of beyond the image is dark.
        return share * ((seen >= -0.5) & (seen <= size - 0.5))[:, None]

    def forward(self, radial: Tensor, amplitude: Tensor) -> tuple[Tensor, Tensor]:
        """Return distance and amplitude without stray light."""
        lit = radial.isfinite() & (radial > 0) & (amplitude > 0) & amplitude.isfinite()
        phase = torch.where(lit, radial, torch.zeros_like(radial)) * self.turns_per_metre
        light = torch.where(lit, amplitude, torch.zeros_like(amplitude))
        real, imaginary = light * phase.cos(), light * phase.sin()
        own, own_imaginary = real, imaginary
        for _ in range(self.rounds):
            stray, stray_imaginary = self.scattered(own), self.scattered(own_imaginary)
            own, own_imaginary = real - stray, imaginary - stray_imaginary
        # The angle by which the phasor turns, small whatever the distance.
        turned = torch.atan2(
            own_imaginary * real - own * imaginary, own * real + own_imaginary * imaginary
        )
        strength = (own.square() + own_imaginary.square()).sqrt()
        corrected = torch.where(lit, radial + turned / self.turns_per_metre, radial)
        return corrected, torch.where(lit, strength, amplitude)

    def scattered(self, image: Tensor) -> Tensor:
        """Return the stray light of an image of light that reaches the lens, the same shape."""
        flat = image.reshape(-1, 1, self.height, self.width)
        cells = avg_pool2d(flat, self.cell, ceil_mode=True, count_include_pad=False)
        ways = self.rows @ cells @ self.columns.transpose(-2, -1)
        stray = (ways * self.shares[:, None, None]).sum(1, keepdim=True)
        stray = interpolate(
            stray, scale_factor=float(self.cell), mode="bilinear", align_corners=False
        )[..., : self.height, : self.width]
        return (stray + self.veil * flat.mean((2, 3), keepdim=True)).reshape(image.shape)
