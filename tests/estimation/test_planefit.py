"""Planes are found in distances along rays, whatever else the pixels show."""

import pytest
import torch
from optional import present
from torch import Generator, Tensor

from tofcorr.estimation.robust import deviation, fit_plane, largest_plane

PLANE = torch.tensor([0.2, -0.1, 0.7], dtype=torch.float64)


def view(share_off: float, generator: Generator) -> tuple[Tensor, Tensor, Tensor]:
    """Return rays, distances with noise, and which of the pixels lie on the plane."""
    place = torch.rand(3000, 2, generator=generator, dtype=torch.float64) - 0.5
    rays = torch.nn.functional.normalize(torch.cat([place, torch.ones(3000, 1)], dim=1), dim=1)
    noise = torch.randn(3000, generator=generator, dtype=torch.float64)
    on_plane = torch.rand(3000, generator=generator) >= share_off
    distance = 1 / (rays @ PLANE) + 1e-3 * noise
    clutter = 0.5 + torch.rand(3000, generator=generator, dtype=torch.float64)
    return rays, torch.where(on_plane, distance, clutter), on_plane


@pytest.mark.parametrize("share_off", [0.0, 0.1])
def test_a_robust_fit_ignores_a_few_other_pixels(share_off: float, generator: Generator) -> None:
    rays, distance, _ = view(share_off, generator)
    valid = torch.ones(1, len(rays), dtype=torch.bool)
    found = fit_plane(rays, distance[None], valid)[0]
    # 3000 pixels of 1 mm noise: an offset to 0.02 mm, tilts to 0.1 mrad; five of these.
    torch.testing.assert_close(found, PLANE, rtol=0.0, atol=5e-4)


def test_the_largest_plane_is_found_among_more_clutter(generator: Generator) -> None:
    rays, distance, on_plane = view(0.6, generator)
    found = present(largest_plane(rays, distance, 0.01, generator))
    near = deviation(rays, distance, found).abs() < 0.01
    assert bool(near[on_plane].all())
    assert float(near[~on_plane].double().mean()) < 0.1


def test_pixels_on_one_line_determine_no_plane(generator: Generator) -> None:
    rays = torch.nn.functional.normalize(torch.rand(50, 1).double() * torch.tensor([[1.0, 0, 0]]))
    assert largest_plane(rays, torch.ones(50).double(), 0.01, generator) is None
    assert largest_plane(rays[:2], torch.ones(2).double(), 0.01, generator) is None
