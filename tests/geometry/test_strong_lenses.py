"""Viewing rays of lenses so strong that the usual iterations do not find them."""

import cameras
import pytest
import torch

from tofcorr.geometry.camera import CameraIntrinsics
from tofcorr.geometry.rays import lens_misses, ray_directions


def _camera(focal: float, *distortion: float) -> CameraIntrinsics:
    return cameras.camera((64, 50), (focal, focal), (31.5, 24.5), *distortion)


@pytest.mark.parametrize(
    ("focal", "distortion"),
    [
        (30.0, (0.8, 0.3, 0.0, 0.0)),
        (25.0, (3.0, 0.0, 0.0, 0.0)),
        (60.0, (-0.3, 0.0, 0.0, 0.0)),
        (90.0, (-0.08, 0.02, 0.0005, -0.0004, 0.01)),
        (90.0, ()),
    ],
)
def test_opencvs_equations_image_every_ray_on_its_pixel(
    focal: float, distortion: tuple[float, ...]
) -> None:
    """A pincushion of k1 = 0.8 left a quarter of the rays up to 2 pixels from theirs."""
    camera = _camera(focal, *distortion)
    x, y, z = ray_directions(camera).unbind(-1)
    x, y = x / z, y / z
    k1, k2, p1, p2, k3 = (*distortion, 0.0, 0.0, 0.0, 0.0, 0.0)[:5]
    r2 = x * x + y * y
    radial = 1 + k1 * r2 + k2 * r2**2 + k3 * r2**3
    across = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
    down = y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y
    v, u = torch.meshgrid(torch.arange(50).double(), torch.arange(64).double(), indexing="ij")
    torch.testing.assert_close(focal * across + 31.5, u, rtol=0.0, atol=1e-8)
    torch.testing.assert_close(focal * down + 24.5, v, rtol=0.0, atol=1e-8)
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
