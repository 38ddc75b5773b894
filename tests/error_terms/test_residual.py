"""What the residual network promises before anybody has trained it, and outside its range."""

from dataclasses import replace

import kinds_of_terms
import torch
from torch import Generator

from tofcorr.error_terms.base import Domain, Interval
from tofcorr.error_terms.residual import ResidualNetwork, ResidualNetworkOptions

DOMAIN = replace(kinds_of_terms.DOMAIN, radial_distance=Interval(1.0, 3.0))
ROWS = torch.arange(5, dtype=torch.float64)[:, None]
COLUMNS = torch.arange(7, dtype=torch.float64)[None, :]


def trained(generator: Generator, domain: Domain = DOMAIN) -> ResidualNetwork:
    network = ResidualNetwork(ResidualNetworkOptions(bound_mm=15.0), domain)
    size = network.weight_vector().shape
    network.set_weight_vector(3 * torch.randn(size, generator=generator, dtype=torch.float64))
    return network


def test_it_adds_nothing_untrained_and_its_bound_at_most(generator: Generator) -> None:
    network = ResidualNetwork(ResidualNetworkOptions(), DOMAIN)
    distance = 1 + 2 * torch.rand(3, 5, 7, generator=generator, dtype=torch.float64)
    assert not network(distance, 100 * distance, ROWS, COLUMNS).any()
    network = trained(generator)
    distance = 5 * torch.rand(50, 5, 7, generator=generator, dtype=torch.float64)
    found = network(distance, 200 * distance, ROWS, COLUMNS).detach().abs()
    assert 0.010 < float(found.max()) <= 0.015


def test_it_fades_to_zero_outside_the_calibrated_ranges(generator: Generator) -> None:
    network = trained(generator)
    inside = torch.full((5, 7), 2.0, dtype=torch.float64)
    amplitude = torch.full((5, 7), 100.0, dtype=torch.float64)
    assert network(inside, amplitude, ROWS, COLUMNS).abs().min() > 0
    for distance, strength in (
        (0.89, 100.0), (3.11, 100.0), (2.0, 7.0), (2.0, 1200.0), (torch.inf, 1.0), (2.0, torch.inf)
    ):  # fmt: skip
        far = torch.full((5, 7), distance, dtype=torch.float64)
        found = network(far, torch.full_like(far, strength), ROWS, COLUMNS)
        assert not found.any()
    distance = torch.linspace(2.9, 3.2, 3001, dtype=torch.float64)[:, None, None]
    found = network(distance, torch.full_like(distance, 100.0), ROWS, COLUMNS)
    assert float(found.detach().diff(dim=0).abs().max()) < 1e-4


def test_it_scripts_identically_and_needs_no_amplitude(generator: Generator) -> None:
    bare = Domain(height=5, width=7, radial_distance=Interval(1.0, 3.0))
    for domain in (DOMAIN, bare):
        network = trained(generator, domain)
        distance = 1 + 2 * torch.rand(3, 5, 7, generator=generator, dtype=torch.float64)
        amplitude = 300 * distance if domain is DOMAIN else torch.full_like(distance, torch.nan)
        found = network(distance, amplitude, ROWS, COLUMNS)
        assert found.isfinite().all()
        scripted = torch.jit.script(network)
        torch.testing.assert_close(scripted(distance, amplitude, ROWS, COLUMNS), found)
