"""A small network that learns the error that remains after the terms."""

from typing import Any

import torch
from pydantic import Field, NonNegativeInt, PositiveFloat, PositiveInt
from torch import Tensor, nn

from tofcorr.error_terms.base import DescribedModule, DescribedOptions, Domain, Interval

# Beyond the calibrated range the network fades to zero within this share of its half-width (no
# unit). Set by hand: short against the range, and long enough for a smooth step.
_FADE = 0.1
# Standard deviation of the first layer's weights at the start (no unit): a neuron's step then
# spans about a quarter of an input's range, so that waves can be learnt. Set by hand.
_STEEPNESS = 3.0


class ResidualNetworkOptions(DescribedOptions):
    """Options of `ResidualNetwork`.

    Attributes:
        width: Neurons of each of the two hidden layers.
        bound_mm: The network never adds more than this.
        seed: Seed of the hidden layers' random start.
    """

    width: PositiveInt = Field(default=16, le=128)
    bound_mm: PositiveFloat = 20.0
    seed: NonNegativeInt = 0

    def structure(self) -> dict[str, Any]:
        """Return the options that fix the set of functions; the seed only fixes the start."""
        values = super().structure()
        del values["seed"]
        return values


class ResidualNetwork(DescribedModule):
    r"""Two hidden layers of tanh, added to the terms: bounded, and zero until it is trained.

    .. math:: R = b \, f(D) f(I) \tanh(w^T h(D, \ln I, r, c))

    The last layer starts at zero, so that an untrained network predicts exactly nothing. The
    fades f are one inside the calibrated ranges and fall smoothly to zero outside: where the
    network has learnt nothing, it adds nothing.

    Args:
        options: Width and bound.
        domain: The ranges scale the inputs; without amplitudes the network does not read them.

    Shape:
        - Input: `(*)` radial distances in metres, amplitudes in the camera's units, rows and
          columns in pixels, which broadcast.
        - Output: `(*)`, predicted errors in metres.
    """

    centre: Tensor
    half_width: Tensor
    floor: Tensor

    def __init__(self, options: ResidualNetworkOptions, domain: Domain) -> None:
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
        self.margin: float = _FADE
        self.bound: float = options.bound_mm / 1000
        self.first = nn.Linear(4, options.width, dtype=torch.float64)
        self.second = nn.Linear(options.width, options.width, dtype=torch.float64)
        self.last = nn.Linear(options.width, 1, dtype=torch.float64)
        _initialise(self.first, self.second, self.last, seed=options.seed)

    def description(self) -> dict[str, Any]:
        """Return size, bound, and whether the network reads amplitudes."""
        return super().description() | {"uses_amplitude": self.uses_amplitude}

    def forward(
        self, radial_distance: Tensor, amplitude: Tensor, rows: Tensor, columns: Tensor
    ) -> Tensor:
        """Return the predicted error, shape (...), metres."""
        return self.of_scaled(*self.scaled(radial_distance, amplitude, rows, columns))

    def scaled(
        self, radial_distance: Tensor, amplitude: Tensor, rows: Tensor, columns: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Return what of `forward` depends on no weight: inputs (..., 4), and most metres (...)."""
        strength = torch.zeros_like(radial_distance)
        if self.uses_amplitude:
            strength = torch.maximum(amplitude, self.floor).log()
        given = torch.broadcast_tensors(radial_distance, strength, rows, columns)
        inputs = (torch.stack(given, dim=-1) - self.centre) / self.half_width
        fade = self.fade(inputs[..., 0]) * self.fade(inputs[..., 1])
        # Far outside, where the fade is zero, the network must still be finite.
        return inputs.clamp(-2.0, 2.0), self.bound * fade

    def of_scaled(self, inputs: Tensor, most: Tensor) -> Tensor:
        """Return the predicted error, shape (...), metres, from what `scaled` returns."""
        hidden = torch.tanh(self.second(torch.tanh(self.first(inputs))))
        return most * torch.tanh(self.last(hidden).squeeze(-1))

    def fade(self, scaled: Tensor) -> Tensor:
        """Return 1 on [-1, 1], 0 beyond the fading zone, and a smooth step between."""
        left = ((1.0 + self.margin - scaled.abs()) / self.margin).clamp(0.0, 1.0)
        return left * left * (3.0 - 2.0 * left)

    def weight_vector(self) -> Tensor:
        """Return all weights as one vector, detached, float64."""
        return nn.utils.parameters_to_vector(self.parameters()).detach().clone()

    def set_weight_vector(self, values: Tensor) -> None:
        """Set all weights from one vector; inverse of `weight_vector`."""
        with torch.no_grad():
            nn.utils.vector_to_parameters(values.to(torch.float64), self.parameters())


@torch.no_grad()
def _initialise(first: nn.Linear, second: nn.Linear, last: nn.Linear, seed: int) -> None:
    generator = torch.Generator().manual_seed(seed)
    # Steps of different width, their centres spread over the inputs' range.
    first.weight.copy_(torch.randn(first.weight.shape, generator=generator) * _STEEPNESS)
    middle = 2 * torch.rand(first.weight.shape, generator=generator) - 1
    first.bias.copy_(-(first.weight * middle).sum(dim=1))
    spread = second.in_features**-0.5
    second.weight.copy_(torch.randn(second.weight.shape, generator=generator) * spread)
    second.bias.zero_()
    last.weight.zero_()
    last.bias.zero_()
