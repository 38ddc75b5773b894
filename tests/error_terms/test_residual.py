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
    with torch.no_grad():
        network.weights.copy_(0.02 * torch.randn(len(network.weights), generator=generator))
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


def test_it_is_zero_a_radius_away_from_all_that_it_has_seen_and_smooth_on_the_way(
    generator: Generator,
) -> None:
    network = trained(generator)
    distance = 1.2 + 0.05 * torch.randn(500, generator=generator).double().clamp(-2, 2)
    rows, columns = (torch.full_like(distance, one) for one in (1.0, 2.0))
    seen = network.scaled(distance, 100 * torch.ones_like(distance), rows, columns)
    network.look_at(seen)
    with torch.no_grad():
        network.weights.mul_(0.02)  # Below the bound, which has an edge.
    assert all((seen == place).all(dim=1).any() for place in network.places)
    # One and a half times half of the range of 2 m beyond the farthest one that was seen.
    edge = float(distance.max()) + 1.5
    path = torch.linspace(1.1, 2.9, 10001, dtype=torch.float64)
    found = network(path, torch.full_like(path, 100.0), *(one[:1] for one in (rows, columns)))
    assert found[path < 1.4].abs().max() > 1e-4
    assert not found[path >= edge].any()
    slope = found.detach().diff() / path.diff()
    assert float(slope.diff().abs().max()) < 0.03 * float(slope.abs().max())


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
