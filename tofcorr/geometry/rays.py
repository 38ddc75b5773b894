"""The viewing ray of every pixel."""

from functools import lru_cache

import torch
from jaxtyping import Float
from kornia.geometry.calibration import distort_points, undistort_points
from torch import Tensor

from tofcorr.geometry.camera import CameraIntrinsics

# Fixed-point iterations of the inverse distortion. Each reduces the error by a factor of about the
# relative distortion at the image border: with most lenses the rounding of float64 is left.
_ITERATIONS = 20
# Distance from a pixel to the image of its ray, pixels, from which Newton's steps follow, and their
# number: far below any calibration and far above rounding, and twice the steps that the lenses of
# the tests need. With a pincushion of k1 = 0.8 the iterations swing to and fro at the border.
_MISSED, _NEWTON_STEPS = 1e-9, 20
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
    pixels = _pixels(camera)
    if camera.distortion:
        pixels = _undistorted(pixels, camera)
    homogeneous = torch.cat([pixels, torch.ones_like(pixels[..., :1])], dim=-1)
    rays = torch.linalg.solve(camera.matrix_tensor(), homogeneous.T).T
    unit = torch.nn.functional.normalize(rays, dim=-1)
    return unit.reshape(camera.height, camera.width, 3)


def _pixels(camera: CameraIntrinsics) -> Float[Tensor, "N 2"]:
    """Return the coordinates of all pixels, row by row: to the right, then down."""
    rows = torch.arange(camera.height, dtype=torch.float64)
    columns = torch.arange(camera.width, dtype=torch.float64)
    return torch.stack(torch.meshgrid(rows, columns, indexing="ij")[::-1], dim=-1).reshape(-1, 2)


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
    points = (rays[..., :2] / rays[..., 2:]).reshape(-1, 2)
    matrix = camera.matrix_tensor()
    plain = points * matrix[[0, 1], [0, 1]] + matrix[:2, 2]
    return _misses(plain, _pixels(camera), camera).reshape(camera.height, camera.width)


def moved_rays(
    rays: Float[Tensor, "*M 3"],
    normal: Float[Tensor, "*M 3"],
    distance: Float[Tensor, "*M"],
    move: tuple[Float[Tensor, "*M"], Float[Tensor, "*M"]],
    depth_kind: str,
) -> Float[Tensor, "*M"]:
    """Return what the rays of another lens do to the distances of points to their planes, metres.

    Args:
        rays: Unit rays.
        normal: Unit normals of the planes, in the camera frame.
        distance: Along the rays, metres.
        move: By how much x and y of the rays (x, y, 1) move.
        depth_kind: `radial` or `z`: which of them stays as it was measured.
    """
    toward = torch.stack([*move, torch.zeros_like(move[0])], dim=-1) * rays[..., 2:]
    if depth_kind == "radial":
        toward = toward - rays * (toward * rays).sum(-1, keepdim=True)
    return (toward * normal).sum(-1) * distance


def _undistorted(wanted: Float[Tensor, "N 2"], camera: CameraIntrinsics) -> Float[Tensor, "N 2"]:
    matrix = camera.matrix_tensor()[None]
    distortion = torch.tensor([camera.distortion], dtype=torch.float64)
    parts = [
        undistort_points(part[None], matrix, distortion, num_iters=_ITERATIONS)[0]
        for part in wanted.split(_AT_ONCE)
    ]
    return _improved(torch.cat(parts), wanted, camera)


def _distorted(points: Float[Tensor, "N 2"], camera: CameraIntrinsics) -> Float[Tensor, "N 2"]:
    """Return where the lens images points that a lens without distortion would image here."""
    distortion = torch.tensor([camera.distortion], dtype=torch.float64)
    return distort_points(points[None], camera.matrix_tensor()[None], distortion)[0]


def _misses(
    found: Float[Tensor, "N 2"], wanted: Float[Tensor, "N 2"], camera: CameraIntrinsics
) -> Float[Tensor, "N"]:
    off = torch.linalg.vector_norm(_distorted(found, camera) - wanted, dim=-1)
    return off.nan_to_num(nan=torch.inf, posinf=torch.inf)


def _improved(
    found: Float[Tensor, "N 2"], wanted: Float[Tensor, "N 2"], camera: CameraIntrinsics
) -> Float[Tensor, "N 2"]:
    """Return the points with those that are missed by more than rounding found by Newton's steps.

    A point that these do not find either, or find where the lens turns the image over, stays.
    """
    before = _misses(found, wanted, camera)
    missed = (before > _MISSED).nonzero()[:, 0]
    if not len(missed):
        return found
    goal = wanted[missed]
    here, centre, area = goal, camera.matrix_tensor()[:2, 2], torch.ones_like(goal[:, 0])
    for _ in range(_NEWTON_STEPS):
        with torch.enable_grad():
            point = here.detach().requires_grad_(True)
            image = _distorted(point, camera)
            # A point's image depends on that point alone.
            slopes = [
                torch.autograd.grad(image[:, axis].sum(), point, retain_graph=True)[0]
                for axis in (0, 1)
            ]
        (xx, xy), (yx, yy) = (slope.unbind(dim=1) for slope in slopes)
        off_x, off_y = (image.detach() - goal).unbind(dim=1)
        area = xx * yy - xy * yx
        step = torch.stack([yy * off_x - xy * off_y, xx * off_y - yx * off_x], dim=1)
        here = here - step / area[:, None]
    same_side = ((here - centre) * (goal - centre)).sum(dim=1) > 0
    better = (area > 0) & same_side & (_misses(here, goal, camera) < before[missed])
    return found.index_copy(0, missed[better], here[better])
