r"""What the removal of second bounces leaves, by a network that has seen other scenes.

Planes that second bounces bend by a decimetre are found too roughly, and what a box hides lights
the room all the same. A small U-Net over the cells of a frame learns what is left then:

.. math:: \delta_i = r_i \, b \, f_i \min(1, \max_j |\Delta_j| / (\lambda r_j)) \tanh u_i

:math:`\Delta` is what was removed, u the network's output, b the largest share that was left in
scenes that it saw, f a factor that falls to zero where a cell's inputs leave the range of those
scenes. In a frame without second bounces nothing is added.
"""

from typing import Annotated

import torch
from pydantic import Field, NonNegativeInt, PositiveInt
from torch import Tensor, nn
from torch.nn.functional import avg_pool2d, interpolate, relu

from tofcorr.options import FADE, Options

_FROM = 0.005
"""Share of the distance that second bounces must add somewhere in a frame, and by which a cell is
off its plane. Chosen: about the noise of cameras."""
_READ = ("shift", "level", "distance", "off", "cosine", "grey", "x", "y", "z", "large", "known")
"""What the network reads of a cell; x, y and z of the normal."""


class RemainderOptions(Options):
    """How the network is trained.

    Attributes:
        scenes: How many are drawn. A fifth is held out.
        width: Features of the network at full resolution.
        seed: Of scenes and network.
    """

    scenes: Annotated[int, Field(ge=20)] = 600
    width: PositiveInt = 4
    seed: NonNegativeInt = 0


class Remainder(nn.Module):
    """The network, on cells.

    All its numbers are parameters, the ranges too: one vector holds them.

    Args:
        rows: Rows of cells.
        width: Features at full resolution; twice as many below.
    """

    def __init__(self, rows: int, width: int) -> None:
        super().__init__()
        self.rows, self.least, self.margin = rows, _FROM, FADE
        wide = 2 * width
        self.first = nn.Conv2d(len(_READ), width, 3, padding=1)
        self.down = nn.ModuleList(
            nn.Conv2d(channels, wide, 3, padding=1) for channels in (width, wide, wide, wide)
        )
        self.up = nn.ModuleList(
            nn.Conv2d(channels, out, 3, padding=1)
            for channels, out in ((2 * wide, wide), (2 * wide, wide), (wide + width, width))
        )
        self.last = nn.Conv2d(width, 1, 1)
        for values in self.last.parameters():
            nn.init.zeros_(values)
        one = torch.ones(len(_READ), 1, 1)
        self.low, self.high, self.mean, self.deviation, self.bound = (
            nn.Parameter(values, requires_grad=False)
            for values in (one, one.clone(), one.clone(), one.clone(), torch.zeros(()))
        )

    def inputs(self, measured: Tensor, light: Tensor, planes: Tensor, known: Tensor) -> Tensor:
        """Return what the network reads of the cells, (11, R, C).

        Args:
            measured: Distances and what was removed of them (2, N), metres.
            light: Amplitudes times the gain (N,).
            planes: g of 1 / r = g . ray, and the rays (2, 3, N).
            known: Which are on a large plane (N,).
        """
        here, normal = measured[0] - measured[1], -nn.functional.normalize(planes[0], dim=0)
        cosine = -(normal * planes[1]).sum(0).clamp(max=-self.least)
        off = torch.tanh((here * (planes[0] * planes[1]).sum(0) - 1.0) / self.least)
        grey = (light * here.square() / cosine + self.least).log()
        level, share = (here / here.nanmedian()).log(), measured[1] / here
        read = torch.stack([share, level, here.log(), off, cosine, grey])
        read = torch.cat([read, normal, torch.stack([known.to(here.dtype), torch.ones_like(here)])])
        read = torch.where(read.isfinite().all(0), read, 0.0)
        return read.reshape(read.shape[0], self.rows, -1)

    def forward(self, read: Tensor) -> Tensor:
        """Return what is to be removed besides, shares of the distance (B, R, C).

        Args:
            read: From `inputs` (B, 11, R, C).
        """
        read = read.to(self.low.dtype)
        held = torch.minimum(torch.maximum(read, self.low), self.high)
        beyond = 2.0 * (read - held).abs() / (self.high - self.low).clamp(min=self.least)
        fade = (1.0 - beyond / self.margin).clamp(0.0, 1.0).amin(1) * read[:, -1]
        some = (read[:, 0].abs().amax((1, 2), keepdim=True) / self.least).clamp(max=1.0)
        x = relu(self.first((held - self.mean) / self.deviation))
        passed: list[Tensor] = []
        for number, layer in enumerate(self.down):
            if number < 3:
                passed.append(x)
                x = relu(layer(avg_pool2d(x, 2, ceil_mode=True)))
            else:
                x = x + relu(layer(x))
        for layer in self.up:
            beside = passed.pop()
            x = interpolate(x, beside.shape[2:], mode="bilinear", align_corners=False)
            x = relu(layer(torch.cat([x, beside], dim=1)))
        return self.bound * fade * some * torch.tanh(self.last(x)[:, 0])

    def numbers(self) -> Tensor:
        """Return all numbers as one vector, detached, float64."""
        return nn.utils.parameters_to_vector(self.parameters()).detach().double()

    @torch.no_grad()
    def set_numbers(self, values: Tensor) -> None:
        """Set all numbers from one vector; inverse of `numbers`."""
        nn.utils.vector_to_parameters(values.float(), self.requires_grad_(False).parameters())
