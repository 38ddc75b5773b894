"""A ghost is the image turned half round about the optical axis, and smaller."""

import cameras
import pytest
import torch

from tofcorr.geometry.camera import CameraIntrinsics
from tofcorr.simulation.effects.stray_light import ghost

WIDTH, HEIGHT = 41, 31


def camera(column: float, row: float) -> CameraIntrinsics:
    return cameras.camera((WIDTH, HEIGHT), (40.0, 40.0), (column, row))


@pytest.fixture
def images() -> torch.Tensor:
    generator = torch.Generator().manual_seed(3)
    return torch.randn(2, HEIGHT, WIDTH, generator=generator, dtype=torch.complex128)


def test_a_ghost_of_full_size_is_the_image_turned_half_round(images: torch.Tensor) -> None:
    found = ghost(images, camera(20.0, 15.0), 1.0)
    torch.testing.assert_close(found, images.flip(1, 2))


@pytest.mark.parametrize("size", [0.5, 0.8])
def test_a_point_is_seen_on_the_other_side_of_the_optical_axis(size: float) -> None:
    """In polar coordinates about the axis: at the same angle plus 180 degrees, and nearer to it."""
    axis, spot = torch.tensor([22.0, 14.0]), torch.tensor([32.0, 19.0])
    column, row = torch.meshgrid(torch.arange(WIDTH), torch.arange(HEIGHT), indexing="xy")
    places = torch.stack([column, row], dim=-1).double()
    bump = torch.exp(-(places - spot).square().sum(-1) / 8)[None].to(torch.complex128)
    weight = ghost(bump, camera(*axis.tolist()), size).real[0]
    centre = (places * weight[..., None]).sum((0, 1)) / weight.sum()
    expected = axis - size * (spot - axis)
    torch.testing.assert_close(centre, expected.double(), atol=0.02, rtol=0)


def test_beyond_its_edge_a_ghost_is_dark_and_ghosts_of_sums_add(images: torch.Tensor) -> None:
    found = ghost(images, camera(20.0, 15.0), 0.5)
    inside = found[:, 8:23, 10:31]
    assert bool((inside.abs() > 1e-9).all())
    assert int((found.abs() > 1e-9).sum()) == inside.numel()
    seen = camera(18.3, 16.2)
    both = ghost(images[:1] + 2j * images[1:], seen, 0.7)
    each = ghost(images, seen, 0.7)
    torch.testing.assert_close(both, each[:1] + 2j * each[1:])
