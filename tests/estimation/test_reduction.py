"""Sums of frame images times static images, on the short way and on the long one."""

from collections.abc import Callable

import pytest
import torch
from torch import Tensor

from tofcorr.estimation.accumulator import PixelReduction

HEIGHT, WIDTH = 7, 40


def smooth_images(generator: torch.Generator) -> Tensor:
    """Polynomials of degree 5 along the row, as products of rays and pixel polynomials are."""
    powers = torch.stack([torch.linspace(-1, 1, WIDTH, dtype=torch.float64) ** k for k in range(6)])
    mixed = torch.randn(3, HEIGHT, 6, generator=generator, dtype=torch.float64)
    return mixed @ powers


def rough_images(generator: torch.Generator) -> Tensor:
    return torch.randn(3, HEIGHT, WIDTH, generator=generator, dtype=torch.float64)


def step_image(generator: torch.Generator) -> Tensor:
    """Smooth rows but for one, which no sample of rows need contain."""
    images = smooth_images(generator)
    images[1, 2, WIDTH // 2 :] += 1.0
    return images


@pytest.mark.parametrize("make", [smooth_images, rough_images, step_image])
def test_the_sums_are_those_of_the_pixels(
    make: Callable[[torch.Generator], Tensor], generator: torch.Generator
) -> None:
    static = make(generator)
    images = torch.randn(4, 5, HEIGHT, WIDTH, generator=generator, dtype=torch.float64)
    expected = torch.einsum("bphw,shw->bps", images, static).flatten(0, 1)
    found = PixelReduction(lambda rows: [static[:2, rows], static[2:, rows]], HEIGHT)(images)
    # 280 products of size one, each rounded or projected to 1e-13.
    torch.testing.assert_close(found, expected, rtol=0.0, atol=280 * 1e-13)


def test_smooth_images_shrink_to_a_few_numbers_a_row(generator: torch.Generator) -> None:
    smooth, rough = smooth_images(generator), rough_images(generator)
    assert PixelReduction(lambda rows: [smooth[:, rows]], HEIGHT).size < HEIGHT * WIDTH // 2
    assert PixelReduction(lambda rows: [rough[:, rows]], HEIGHT).size == HEIGHT * WIDTH


def test_the_sums_of_the_first_static_images_alone_are_those_among_all(
    generator: torch.Generator,
) -> None:
    static = smooth_images(generator)
    images = torch.randn(5, HEIGHT, WIDTH, generator=generator, dtype=torch.float64)
    sums = PixelReduction(lambda rows: [static[:, rows]], HEIGHT)
    reduced = sums.reduced(images.split(3, dim=1))
    assert sums.num_static == 3
    found, whole = sums.sums(reduced, 2), sums(images)
    torch.testing.assert_close(found, whole[:, :2], rtol=0.0, atol=1e-13)
