"""Viewing rays of lenses so strong that the usual iterations do not find them."""

import pytest
import torch

from tofcorr.geometry.camera import CameraIntrinsics
from tofcorr.geometry.rays import lens_misses, ray_directions


def _camera(focal: float, *distortion: float) -> CameraIntrinsics:
    matrix = ((focal, 0.0, 31.5), (0.0, focal, 24.5), (0.0, 0.0, 1.0))
    return CameraIntrinsics(width=64, height=50, matrix=matrix, distortion=distortion)


@pytest.mark.parametrize(
    ("focal", "k1", "k2"), [(30.0, 0.8, 0.3), (25.0, 3.0, 0.0), (60.0, -0.3, 0.0)]
)
def test_every_ray_is_imaged_on_its_pixel(focal: float, k1: float, k2: float) -> None:
    """A pincushion of k1 = 0.8 left a quarter of the rays up to 2 pixels from theirs."""
    camera = _camera(focal, k1, k2, 0.0, 0.0)
    rays = ray_directions(camera)
    x, y = rays[..., 0] / rays[..., 2], rays[..., 1] / rays[..., 2]
    square = x.square() + y.square()
    radial = 1 + k1 * square + k2 * square.square()
    v, u = torch.meshgrid(torch.arange(50).double(), torch.arange(64).double(), indexing="ij")
    torch.testing.assert_close(focal * x * radial + 31.5, u, rtol=0.0, atol=1e-8)
    torch.testing.assert_close(focal * y * radial + 24.5, v, rtol=0.0, atol=1e-8)
    assert float(lens_misses(camera).max()) < 1e-8


def test_a_pixel_that_the_lens_does_not_reach_gets_no_ray_of_the_other_side() -> None:
    """Beyond the fold a cubic has a root of opposite sign, which Newton's steps may find."""
    focal, k1 = 45.0, -0.3
    camera = _camera(focal, k1, 0.0, 0.0, 0.0)
    v, u = torch.meshgrid(torch.arange(50).double(), torch.arange(64).double(), indexing="ij")
    from_centre = torch.hypot(u - 31.5, v - 24.5) / focal
    fold = (-1 / (3 * k1)) ** 0.5
    farthest = fold * (1 + k1 * fold**2)
    missed = lens_misses(camera)
    assert bool((missed[from_centre > farthest + 1e-3] > 1e-2).all())
    # All the others have one, up to the last pixel before the fold.
    assert float(missed[from_centre < farthest - 1e-3].max()) < 1e-6
