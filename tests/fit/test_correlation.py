"""Neighbouring pixels that are alike count as fewer, independent ones do not."""

import pytest
import torch
from torch import Tensor

from tofcorr.error_terms.model import Pixels
from tofcorr.fit.linear_image import LinearPixels, block_squares, design_effect
from tofcorr.fit.reference import repeated

HEIGHT, WIDTH = 96, 128


def squares(residual: Tensor, weight: float = 1.0) -> Tensor:
    """Return the sums for an image (H, W) of a wall that all rays meet from the front."""
    grid = torch.meshgrid(torch.arange(HEIGHT), torch.arange(WIDTH), indexing="ij")
    rows, columns = (one.flatten().double() for one in grid)
    one = torch.ones_like(rows)
    image = LinearPixels(
        pixels=Pixels(one, one, rows, columns, torch.zeros(len(rows), 0)),
        ray=torch.stack([columns / WIDTH, rows / HEIGHT, one], dim=1),
        normal=torch.tensor([0.0, 0.0, -1.0]).double().expand(len(rows), 3),
        distance=one,
        residual=residual.flatten(),
        gain=-one,
        unknowns=torch.zeros(len(rows), 0),
    )
    return block_squares(image, weight * one)


@pytest.mark.parametrize("side", [1, 2, 4])
def test_pixels_that_are_equal_within_tiles_count_as_one_a_tile(side: int) -> None:
    generator = torch.Generator().manual_seed(side)
    found = torch.zeros(())
    for _ in range(6):
        tiles = torch.randn(HEIGHT // side, WIDTH // side, generator=generator).double()
        residual = tiles.repeat_interleave(side, 0).repeat_interleave(side, 1)
        found = found + squares(residual, weight=4.0)
    # Blocks of 16 pixels, six times 48 of them less what is fitted, know a variance to a tenth;
    # three of these.
    assert design_effect(found) == pytest.approx(side**2, rel=0.3)


def test_what_bends_the_whole_image_is_not_taken_for_noise() -> None:
    generator = torch.Generator().manual_seed(0)
    rows = torch.linspace(-1, 1, HEIGHT).double()[:, None]
    noise = torch.randn(HEIGHT, WIDTH, generator=generator).double()
    bent, flat = (design_effect(squares(one)) for one in (noise + 5 * rows**2, noise))
    assert bent == pytest.approx(flat, rel=1e-6)


@pytest.mark.parametrize("count", [1, 2, 7])
def test_poses_that_persist_are_worth_as_much_as_their_correlation_matrix_says(count: int) -> None:
    lag = (torch.arange(count)[:, None] - torch.arange(count)[None, :]).abs()
    assert repeated(0.6, count) == pytest.approx(float((0.6**lag).sum()) / count)
