"""One example of every registered kind of error term, on two different calibrated ranges."""

from dataclasses import replace
from typing import Any

import torch
from torch import Generator, Tensor

from tofcorr.conditions import CONDITIONS
from tofcorr.error_terms.base import Domain, Interval
from tofcorr.error_terms.model import ErrorModel, ErrorModelOptions
from tofcorr.error_terms.registry import TERMS
from tofcorr.error_terms.residual import ResidualNetwork, ResidualNetworkOptions

KINDS = [*TERMS, "residual_network"]
DOMAIN = Domain(
    height=5,
    width=7,
    radial_distance=Interval(0.5, 3.0),
    amplitude=Interval(10.0, 900.0),
    normalised_amplitude=Interval(10.0, 900.0),
    modulation_frequency=20e6,
    conditions=dict.fromkeys(CONDITIONS, (1.0, 4.0, 2.0)),
)
OTHER_DOMAIN = replace(
    DOMAIN,
    radial_distance=Interval(0.9, 5.0),
    amplitude=Interval(100.0, 2000.0),
    normalised_amplitude=Interval(70.0, 4000.0),
    modulation_frequency=31e6,
    conditions=dict.fromkeys(CONDITIONS, (0.0, 7.0, 3.0)),
)


def built(*terms: dict[str, Any], domain: Domain = DOMAIN) -> ErrorModel:
    """Build an untrained model of some terms."""
    return ErrorModel(ErrorModelOptions.from_mapping({"terms": terms}, "test"), domain)


def model_of(kind: str, domain: Domain = DOMAIN, **options: Any) -> ErrorModel:
    """Build an untrained model of one kind of term."""
    if kind != "residual_network":
        return built({"kind": kind, **options}, domain=domain)
    model = built(domain=domain)
    model.residual = ResidualNetwork(ResidualNetworkOptions(**options), domain)
    return model


def randomise(
    model: torch.nn.Module, generator: Generator, size: float = 1.0, of_network: float = 1.0
) -> None:
    """Give every parameter, and the map of the pixels, random values of these sizes."""
    with torch.no_grad():
        for name, value in [*model.named_parameters(), *model.named_buffers()]:
            if isinstance(value, torch.nn.Parameter) or name.endswith("offset"):
                scale = of_network if "residual.p" in name else size  # Places, and radii.
                value.copy_(scale * torch.randn(value.shape, generator=generator))


def inputs(generator: Generator) -> tuple[Tensor, Tensor, Tensor]:
    """Draw distances and amplitudes (3, 5, 7), and conditions (3, C)."""
    u = torch.rand(2, 3, 5, 7, generator=generator, dtype=torch.float64)
    conditions = 1.0 + 3.0 * torch.rand(3, len(CONDITIONS), generator=generator).double()
    return 0.5 + 2.5 * u[0], 10.0 + 890.0 * u[1], conditions
