"""Blurring is a Gaussian's, and leaves an even image as it is."""

import pytest
import torch
from scipy.ndimage import gaussian_filter

from tofcorr.simulation.effects.base import blur


@pytest.mark.parametrize("sigma", [0.6, 1.2, 2.5])
def test_blurring_is_that_of_scipy(sigma: float) -> None:
    generator = torch.Generator().manual_seed(6)
    image = torch.randn(2, 9, 14, generator=generator, dtype=torch.complex128)
    filtered = [
        gaussian_filter(part, sigma, mode="nearest", radius=round(3 * sigma), axes=(1, 2))
        for part in (image.real.numpy(), image.imag.numpy())
    ]
    expected = torch.complex(*map(torch.from_numpy, filtered))
    torch.testing.assert_close(blur(image, sigma), expected, atol=1e-12, rtol=0)


def test_blurring_widely_by_squares_is_blurring_widely() -> None:
    y, x = torch.meshgrid(torch.arange(60.0), torch.arange(80.0), indexing="ij")
    image = torch.cos(x / 20)[None].double() * torch.cos(y / 15)[None].double()
    torch.testing.assert_close(blur(torch.ones_like(image), 7.0), torch.ones_like(image))
    sigma = 6.0
    # A Gaussian of that width passes cos(k x) with exp(-(k sigma)^2 / 2), away from the edges.
    passed = torch.exp(torch.tensor(-(sigma**2) / 2 * (1 / 20**2 + 1 / 15**2)))
    inner = (slice(None), slice(22, 38), slice(22, 58))
    torch.testing.assert_close(blur(image, sigma)[inner], passed * image[inner], atol=0.03, rtol=0)
