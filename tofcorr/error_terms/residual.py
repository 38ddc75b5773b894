"""A small network that learns the error that remains after the terms, where it has seen it."""

from collections.abc import Sequence
from typing import Any

import torch
from pydantic import Field, NonNegativeInt, PositiveFloat, PositiveInt
from torch import Tensor, nn

from tofcorr.error_terms.base import DescribedModule, DescribedOptions, Domain, Interval
from tofcorr.options import FADE


class ResidualNetworkOptions(DescribedOptions):
    """Options of `ResidualNetwork`.

    Attributes:
        width: Neurons: how many places the network learns about.
        bound_mm: The network never adds more than this; null: it has no bound, and is zero where
            it has seen nothing all the same.
        radius: How far a place is felt, in half-widths of the ranges of distance, log amplitude,
            rows and columns; a fit may change it along each. On a Kinect v2 1.5 and 2 err alike.
        seed: Seed of the places at the start; a fit puts them where it has seen pixels.
    """

    width: PositiveInt = Field(default=256, le=1024)
    bound_mm: PositiveFloat | None = None
    radius: PositiveFloat = 1.5
    seed: NonNegativeInt = 0

    def structure(self) -> dict[str, Any]:
        """Return the options that fix the set of functions; the seed only fixes the start."""
        values = super().structure()
        del values["seed"]
        return values


class ResidualNetwork(DescribedModule):
    r"""Radial functions around places that were seen, zero far from all of them.

    .. math:: R = \Big[ f(D) f(I) \sum_k w_k\, \phi(|s (x - x_k)|) \Big]_{-b}^{b}, \qquad
        \phi(d) = (1 - d)_+^5 (5 d + 1)

    with :math:`x = (D, \ln I, r, c)`, all on the scale of their ranges, and reciprocal radii s.
    Wendland's function (1995) is positive definite in five dimensions and zero from 1 on: at a
    radius from every place :math:`x_k`, where the network has learnt nothing, it adds nothing.
    The fades f do the same outside the calibrated ranges; the bound b is optional. Untrained
    weights w are zero, so that an untrained network predicts exactly nothing.

    Args:
        options: Width and bound.
        domain: The ranges scale the inputs; without amplitudes the network does not read them.
        stretch: How many times longer the radius is along each input.

    Shape:
        - Input: `(*)` radial distances in metres, amplitudes in the camera's units, rows and
          columns in pixels, which broadcast.
        - Output: `(*)`, predicted errors in metres.
    """

    centre: Tensor
    half_width: Tensor
    floor: Tensor

    def __init__(
        self, options: ResidualNetworkOptions, domain: Domain, stretch: Sequence[float] = (1,) * 4
    ) -> None:
        super().__init__()
        self.options = options
        self.uses_amplitude: bool = domain.amplitude is not None
        self.register_number("floor", domain.amplitude_floor() if self.uses_amplitude else 1.0)
        intervals = (
            domain.radial_distance,
            domain.interval("log_amplitude") if self.uses_amplitude else Interval(-1.0, 1.0),
            Interval(0.0, domain.height - 1.0),
            Interval(0.0, domain.width - 1.0),
        )
        for name in ("centre", "half_width"):
            numbers = [getattr(interval, name) for interval in intervals]
            self.register_buffer(name, torch.tensor(numbers, dtype=torch.float64))
        self.margin: float = FADE
        self.bound: float = (options.bound_mm or torch.inf) / 1000
        self.width: int = options.width
        generator = torch.Generator().manual_seed(options.seed)
        places = 2 * torch.rand(options.width, 4, generator=generator, dtype=torch.float64) - 1
        self.places = nn.Parameter(places)
        radii = options.radius * torch.tensor(stretch, dtype=torch.float64)
        self.per_radius = nn.Parameter(1 / radii)
        self.weights = nn.Parameter(torch.zeros(options.width, dtype=torch.float64))

    def description(self) -> dict[str, Any]:
        """Return size, bound, and whether the network reads amplitudes."""
        return super().description() | {"uses_amplitude": self.uses_amplitude}

    def forward(
        self, radial_distance: Tensor, amplitude: Tensor, rows: Tensor, columns: Tensor
    ) -> Tensor:
        """Return the predicted error, shape (...), metres."""
        inputs = self.scaled(radial_distance, amplitude, rows, columns)
        total = torch.zeros_like(inputs[..., 0])
        # Sixteen images of temporaries at once, not hundreds.
        for first in range(0, self.width, 16):
            near = self.functions(inputs, self.places[first : first + 16])
            total = total + (near * self.weights[first : first + 16]).sum(dim=-1)
        return (self.fade(inputs) * total).clamp(-self.bound, self.bound)

    def scaled(
        self, radial_distance: Tensor, amplitude: Tensor, rows: Tensor, columns: Tensor
    ) -> Tensor:
        """Return the inputs on the scale of their ranges, shape (..., 4)."""
        strength = torch.zeros_like(radial_distance)
        if self.uses_amplitude:
            strength = torch.maximum(amplitude, self.floor).log()
        given = torch.broadcast_tensors(radial_distance, strength, rows, columns)
        inputs = (torch.stack(given, dim=-1) - self.centre) / self.half_width
        # Far outside, where every function is zero, the network must still be finite.
        return inputs.clamp(-100.0, 100.0)

    def functions(self, inputs: Tensor, places: Tensor) -> Tensor:
        """Return what the weights of some places (K, 4) multiply, shape (..., K)."""
        apart = (inputs[..., None, :] - places) * self.per_radius
        distance = torch.linalg.vector_norm(apart, dim=-1)
        left = (1.0 - distance).clamp(min=0.0)
        return left.square().square() * left * (5.0 * distance + 1.0)

    def fade(self, inputs: Tensor) -> Tensor:
        """Return 1 in the calibrated ranges, 0 beyond the fading zone, and smooth steps between."""
        left = ((1.0 + self.margin - inputs[..., :2].abs()) / self.margin).clamp(0.0, 1.0)
        return (left * left * (3.0 - 2.0 * left)).prod(dim=-1)

    @torch.no_grad()
    def look_at(self, inputs: Tensor) -> None:
        """Put the places where pixels were seen, each as far as can be from those before it.

        Args:
            inputs: What `scaled` returns of the pixels, shape (M, 4).
        """
        apart = torch.full_like(inputs[:, 0], torch.inf)
        for place in self.places:
            place.copy_(inputs[int(apart.argmax())])
            own = ((inputs - place) * self.per_radius).square().sum(dim=1)
            apart = torch.minimum(apart, own)

    def weight_vector(self) -> Tensor:
        """Return places, radii and weights as one vector, detached, float64."""
        return nn.utils.parameters_to_vector(self.parameters()).detach().clone()

    def set_weight_vector(self, values: Tensor) -> None:
        """Set places, radii and weights from one vector; inverse of `weight_vector`."""
        with torch.no_grad():
            nn.utils.vector_to_parameters(values.to(torch.float64), self.parameters())
