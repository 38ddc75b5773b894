"""Neighbouring pixels that are alike count as fewer, independent ones do not."""

import pytest
import torch
from torch import Tensor

from tofcorr.fit.linear_image import Correlation, LinearImage, shapes
from tofcorr.fit.reference import repeated

HEIGHT, WIDTH = 96, 128


def image(residual: Tensor) -> LinearImage:
    rows, columns = (
        one.flatten().double()
        for one in torch.meshgrid(torch.arange(HEIGHT), torch.arange(WIDTH), indexing="ij")
    )
    gain = torch.full_like(rows, -1.0)
    moves = torch.stack([rows / HEIGHT, columns / WIDTH, -gain], dim=1)
    return LinearImage(
        residual=residual.flatten(),
        gain=gain,
        points=torch.zeros(len(rows), 3),
        moves=moves,
        shapes=shapes(rows, columns).T,
        unknowns=torch.zeros(len(rows), 0),
        amplitude=None,
        rows=rows,
        columns=columns,
        normal=torch.tensor([0.0, 0.0, -1.0]),
    )


@pytest.mark.parametrize("side", [1, 2, 4])
def test_pixels_that_are_equal_within_tiles_count_as_one_a_tile(side: int) -> None:
    generator = torch.Generator().manual_seed(side)
    found = Correlation()
    for _ in range(6):
        tiles = torch.randn(HEIGHT // side, WIDTH // side, generator=generator).double()
        residual = tiles.repeat_interleave(side, 0).repeat_interleave(side, 1)
        found.add(image(residual), torch.full((HEIGHT * WIDTH,), 4.0).double())
    # Blocks of 16 pixels, six times 48 of them less what is fitted, know a variance to a tenth;
    # three of these.
    assert found.design_effect() == pytest.approx(side**2, rel=0.3)


def test_what_bends_the_whole_image_is_not_taken_for_noise() -> None:
    generator = torch.Generator().manual_seed(0)
    rows = torch.linspace(-1, 1, HEIGHT).double()[:, None]
    noise = torch.randn(HEIGHT, WIDTH, generator=generator).double()
    ones = torch.ones(HEIGHT * WIDTH).double()
    flat, bent = Correlation(), Correlation()
    flat.add(image(noise), ones)
    bent.add(image(noise + 5 * rows**2), ones)
    assert bent.design_effect() == pytest.approx(flat.design_effect(), rel=1e-6)


@pytest.mark.parametrize("count", [1, 2, 7])
def test_poses_that_persist_are_worth_as_much_as_their_correlation_matrix_says(count: int) -> None:
    lag = (torch.arange(count)[:, None] - torch.arange(count)[None, :]).abs()
    assert repeated(0.6, count) == pytest.approx(float((0.6**lag).sum()) / count)
