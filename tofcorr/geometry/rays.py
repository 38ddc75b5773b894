"""The viewing ray of every pixel."""

from functools import lru_cache

import torch
from jaxtyping import Float
from kornia.geometry.calibration import distort_points, undistort_points
from torch import Tensor

from tofcorr.geometry.intrinsics import CameraIntrinsics

# Numbers of fixed-point iterations of the inverse distortion that are tried. Each reduces the error
# by a factor of about the relative distortion at the image border: 1e-5 is left after 5 (kornia's
# default), the rounding of float64 after 40, whatever the lens; after 15 of most.
_ITERATIONS = (10, 15, 20, 30, 40)
# Where fewer iterations move no pixel tried further than this from the last, they are enough,
# pixels: a few roundings of a coordinate of some hundreds.
_ROUNDING = 1e-12
# Pixels tried are those of the image border, where iterations converge slowest, and of every so
# many rows and columns. Set by hand.
_TRIED_STEP = 16
_AT_ONCE = 1 << 14
"""Pixels undistorted at once. Their coordinates fit into the cache of a core: half the time for
512 x 424 pixels, a tenth for ten million (measured), and the same rays to the last bit."""


@lru_cache(maxsize=8)
def ray_directions(camera: CameraIntrinsics) -> Float[Tensor, "{camera.height} {camera.width} 3"]:
    """Return the unit viewing ray of every pixel in the camera frame.

    Returns:
        Directions with x to the right, y down and z along the optical axis, shape
        (height, width, 3), norm 1, float64. The tensor is shared: do not write into it.
    """
    rows = torch.arange(camera.height, dtype=torch.float64)
    columns = torch.arange(camera.width, dtype=torch.float64)
    v, u = torch.meshgrid(rows, columns, indexing="ij")
    matrix = camera.matrix_tensor()
    pixels = torch.stack([u, v], dim=-1)
    if camera.distortion:
        pixels = _undistorted(pixels, camera)
    pixels = pixels.reshape(-1, 2)
    homogeneous = torch.cat([pixels, torch.ones_like(pixels[..., :1])], dim=-1)
    rays = torch.linalg.solve(matrix, homogeneous.T).T
    unit = torch.nn.functional.normalize(rays, dim=-1)
    return unit.reshape(camera.height, camera.width, 3)


def lens_misses(camera: CameraIntrinsics) -> Float[Tensor, "{camera.height} {camera.width}"]:
    """Return how far from each pixel the lens model puts the pixel's own viewing ray, pixels.

    Zero to rounding, but where the distortion polynomial turns back before it reaches the pixel:
    no ray is imaged there, and `ray_directions` holds nothing of meaning. A polynomial fitted to
    the middle of a wide image turns back in its corners.

    Returns:
        Shape (height, width), float64, not negative, no NaN.
    """
    if not camera.distortion:
        return torch.zeros(camera.height, camera.width, dtype=torch.float64)
    rays = ray_directions(camera)
    points = (rays[..., :2] / rays[..., 2:]).reshape(1, -1, 2)
    distortion = torch.tensor([camera.distortion], dtype=torch.float64)
    matrix = camera.matrix_tensor()[None]
    plain = points * matrix[:, [0, 1], [0, 1]] + matrix[:, :2, 2]
    found = distort_points(plain, matrix, distortion).reshape(camera.height, camera.width, 2)
    rows = torch.arange(camera.height, dtype=torch.float64)
    columns = torch.arange(camera.width, dtype=torch.float64)
    v, u = torch.meshgrid(rows, columns, indexing="ij")
    miss = torch.linalg.vector_norm(found - torch.stack([u, v], dim=-1), dim=-1)
    return miss.nan_to_num(nan=torch.inf, posinf=torch.inf)


def _undistorted(pixels: Float[Tensor, "H W 2"], camera: CameraIntrinsics) -> Float[Tensor, "N 2"]:
    matrix = camera.matrix_tensor()[None]
    distortion = torch.tensor([camera.distortion], dtype=torch.float64)

    def by(iterations: int, points: Tensor) -> Tensor:
        return undistort_points(points[None], matrix, distortion, num_iters=iterations)[0]

    border = [pixels[0], pixels[-1], pixels[:, 0], pixels[:, -1]]
    tried = torch.cat([*border, pixels[::_TRIED_STEP, ::_TRIED_STEP].flatten(0, 1)])
    last = by(_ITERATIONS[-1], tried)
    enough = next(
        (n for n in _ITERATIONS if bool(((by(n, tried) - last).abs() <= _ROUNDING).all())),
        _ITERATIONS[-1],
    )
    return torch.cat([by(enough, part) for part in pixels.flatten(0, 1).split(_AT_ONCE)])
