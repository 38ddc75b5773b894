"""Viewing rays: of every pixel, distances along them, and planes n . x + d = 0 that they meet."""

import math
from functools import lru_cache

import numpy as np
import torch
from jaxtyping import Bool, Float
from kornia.geometry.calibration import distort_points, undistort_points
from torch import Tensor

from tofcorr.geometry.camera import CameraIntrinsics

Rays = Float[Tensor, "H W 3"]
"""Unit viewing rays of all pixels of an image."""
Images = Float[Tensor, "B H W"]
Chosen = Bool[Tensor, "B H W"]
"""Which pixels of images."""

Places = Float[Tensor, "N 2"]
"""Columns and rows in an image, pixels."""

# Fixed-point iterations of the inverse distortion. Each reduces the error by a factor of about the
# relative distortion at the image border: with most lenses the rounding of float64 is left.
_ITERATIONS = 20
# Distance from a pixel to the image of its ray, pixels, from which Newton's steps follow, and their
# number: far below any calibration and far above rounding, and twice the steps that the lenses of
# the tests need. With a pincushion of k1 = 0.8 the iterations swing to and fro at the border.
_MISSED, _NEWTON_STEPS = 1e-9, 20
AT_ONCE = 1 << 14
"""Pixels undistorted at once. Their coordinates fit into the cache of a core: half the time for
512 x 424 pixels, a tenth for ten million (measured), and the same rays to the last bit."""


@lru_cache(maxsize=8)
def ray_directions(camera: CameraIntrinsics) -> Float[Tensor, "{camera.height} {camera.width} 3"]:
    """Return the unit viewing ray of every pixel in the camera frame.

    Returns:
        Directions with x to the right, y down and z along the optical axis, shape
        (height, width, 3), norm 1, float64. The tensor is shared: do not write into it.
    """
    wanted = pixels = _pixels(camera)
    if camera.distortion:
        lens = camera.matrix_tensor()[None], torch.tensor([camera.distortion], dtype=torch.float64)
        parts = [
            undistort_points(part[None], *lens, num_iters=_ITERATIONS)[0]
            for part in wanted.split(AT_ONCE)
        ]
        pixels = _improved(torch.cat(parts), wanted, camera)
    homogeneous = torch.cat([pixels, torch.ones_like(pixels[..., :1])], dim=-1)
    rays = torch.linalg.solve(camera.matrix_tensor(), homogeneous.T).T
    unit = torch.nn.functional.normalize(rays, dim=-1)
    return unit.reshape(camera.height, camera.width, 3)


def _pixels(camera: CameraIntrinsics) -> Places:
    """Return the coordinates of all pixels, row by row: to the right, then down."""
    rows, columns = torch.arange(camera.height), torch.arange(camera.width)
    return torch.cartesian_prod(rows, columns).flip(1).double()


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


def _distorted(points: Places, camera: CameraIntrinsics) -> Places:
    """Return where the lens images points that a lens without distortion would image here."""
    distortion = torch.tensor([camera.distortion], dtype=torch.float64)
    return distort_points(points[None], camera.matrix_tensor()[None], distortion)[0]


def _misses(found: Places, wanted: Places, camera: CameraIntrinsics) -> Float[Tensor, "N"]:
    off = torch.linalg.vector_norm(_distorted(found, camera) - wanted, dim=-1)
    return off.nan_to_num(nan=torch.inf, posinf=torch.inf)


def _improved(found: Places, wanted: Places, camera: CameraIntrinsics) -> Places:
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
        jacobian = torch.stack(slopes, dim=1)
        area = torch.linalg.det(jacobian)
        here = here - torch.linalg.solve_ex(jacobian, image.detach() - goal).result
    same_side = ((here - centre) * (goal - centre)).sum(dim=1) > 0
    better = (area > 0) & same_side & (_misses(here, goal, camera) < before[missed])
    return found.index_copy(0, missed[better], here[better])


# Smallest |cosine| of the incidence angle (no unit) at which a ray counts as meeting the plane.
# Chosen by hand: at 1e-6 a plane 1 m away is met at 1000 km, far beyond any camera's range.
_GRAZING_COSINE = 1e-6


def plane_in_frame(
    normal_world: Float[Tensor, "*batch 3"],
    offset: Float[Tensor, "*batch"],
    world_from_frame: Float[Tensor, "*batch 4 4"],
) -> tuple[Float[Tensor, "*batch 3"], Float[Tensor, "*batch"]]:
    """Express planes in another frame: x_world = world_from_frame x_frame.

    Args:
        normal_world: Unit normals, shape (..., 3).
        offset: Offsets d of n . x + d = 0, shape (...), metres.
        world_from_frame: Rigid transforms, shape (..., 4, 4).

    Returns:
        Normals (..., 3) and offsets (...) of the same planes in the frame.
    """
    rotation, translation = world_from_frame[..., :3, :3], world_from_frame[..., :3, 3]
    normal = (normal_world[..., None, :] @ rotation)[..., 0, :]
    return normal, offset + (normal_world * translation).sum(-1)


def planes_through(
    points: Float[Tensor, "*batch 4 4"], viewpoint: Float[Tensor, "*#batch 3"]
) -> tuple[Float[Tensor, "*batch 3"], Float[Tensor, "*batch"]]:
    """Return the planes n . x + d = 0 of least squared distances.

    Args:
        points: Sums of (x, 1)(x, 1)^T over the points, shape (..., 4, 4), metres.
        viewpoint: Points that the normals shall face, metres: one for each plane, or for all.

    Returns:
        Unit normals (..., 3) and offsets (...), metres.
    """
    mean = points / points[..., 3:, 3:].clamp(min=torch.finfo(points.dtype).tiny)
    centre = mean[..., 3, :3]
    spread = mean[..., :3, :3] - centre[..., :, None] * centre[..., None, :]
    normal = torch.linalg.eigh(spread).eigenvectors[..., 0]
    facing = (normal * (viewpoint - centre)).sum(-1, keepdim=True)
    normal = torch.where(facing < 0, -normal, normal)
    return normal, -(normal * centre).sum(-1)


def ray_plane_distance(
    ray_directions: Rays,
    normal: Float[Tensor, "*batch 3"],
    offset: Float[Tensor, "*batch"],
) -> Float[Tensor, "*batch H W"]:
    """Return how far along each ray from the origin its plane lies.

    Args:
        ray_directions: Unit rays, shape (H, W, 3).
        normal: Unit normals in the frame of the rays, shape (..., 3).
        offset: Offsets, shape (...), metres.

    Returns:
        Distances, shape (..., H, W), metres; NaN where the ray is parallel to the plane or the
        plane lies behind the origin.
    """
    cosine = torch.einsum("hwk,...k->...hw", ray_directions, normal)
    distance = -offset[..., None, None] / cosine
    meets = (cosine.abs() > _GRAZING_COSINE) & (distance > 0)
    return torch.where(meets, distance, torch.nan)


def tangents(normal: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 2 3"]:
    """Return two unit vectors that span the plane of each normal.

    The first is n x e, normalised, with e the coordinate axis that is farthest from n; the second
    is n x first. They are orthogonal to each other and to n.

    Args:
        normal: Unit normals, shape (..., 3).

    Returns:
        Shape (..., 2, 3).
    """
    axis = torch.eye(3, dtype=normal.dtype, device=normal.device)[normal.detach().abs().argmin(-1)]
    first = torch.nn.functional.normalize(torch.linalg.cross(normal, axis), dim=-1)
    return torch.stack([first, torch.linalg.cross(normal, first)], dim=-2)


def plane_moves(normal: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3 4"]:
    """Return what two turns about `tangents` and a shift add to (n, d), a row each."""
    turns = torch.nn.functional.pad(tangents(normal), (0, 1))
    shift = torch.nn.functional.pad(torch.zeros_like(normal), (0, 1), value=1.0)
    return torch.cat([turns, shift[..., None, :]], dim=-2)


def plane_precision(
    normal: Float[Tensor, "*batch 3"], covariance: Float[Tensor, "*batch 4 4"]
) -> Float[Tensor, "*batch 3 3"]:
    """Return the inverse covariance of the steps of `plane_moves`, from that of (n, d).

    A hundredth of a millimetre, or milliradian, is added: what is known better is known exactly.
    """
    moves, least = plane_moves(normal), torch.eye(3).to(normal) / 100_000**2
    return torch.linalg.inv(moves @ covariance @ moves.mT + least)


SPEED_OF_LIGHT = 299_792_458.0
"""In vacuum, metres per second. Exact by the definition of the metre."""
# How far an error may be from a whole number of unambiguous ranges, metres. Chosen: twice what
# errors of cameras reach; a seventh of all errors would be so near by chance at 100 MHz.
_WRAPPED_WITHIN = 0.1


def radial_distance_from_z_depth(z_depth: Tensor, ray_directions: Tensor) -> Tensor:
    """Convert the coordinate along the optical axis into the distance along the ray.

    Args:
        z_depth: Coordinates along the optical axis, shape (..., H, W), metres.
        ray_directions: Unit viewing rays, shape (H, W, 3).

    Returns:
        Radial distances, shape (..., H, W), metres.
    """
    _check_sizes(z_depth, ray_directions, "z_depth")
    return z_depth / ray_directions[..., 2].to(z_depth)


def z_depth_from_radial_distance(radial_distance: Tensor, ray_directions: Tensor) -> Tensor:
    """Convert the distance along the ray into the coordinate along the optical axis.

    Args:
        radial_distance: Distances along the rays, shape (..., H, W), metres.
        ray_directions: Unit viewing rays, shape (H, W, 3).

    Returns:
        Coordinates along the optical axis, shape (..., H, W), metres.
    """
    _check_sizes(radial_distance, ray_directions, "radial_distance")
    return radial_distance * ray_directions[..., 2].to(radial_distance)


def unambiguous_range(modulation_frequency: float) -> float:
    """Return c / 2f in metres: the distance after which the phase repeats."""
    return SPEED_OF_LIGHT / (2.0 * modulation_frequency)


def wrapped(errors: np.ndarray, modulation_frequency: float | None) -> np.ndarray:
    """Return which errors are whole unambiguous ranges, as where a phase wrapped, same shape.

    A camera measures a distance beyond its unambiguous range as nearer by that range. One that
    combines several frequencies may take the wrong period, and is off by several ranges of one.

    Args:
        errors: Measured less true distances, any shape, metres.
        modulation_frequency: In Hz; None: unknown, and no error is.
    """
    if modulation_frequency is None:
        return np.zeros(errors.shape, dtype=bool)
    full = unambiguous_range(modulation_frequency)
    whole = np.round(errors / full)
    return (whole != 0) & (np.abs(errors - whole * full) < _WRAPPED_WITHIN)


def mostly_wrapped(errors: np.ndarray, modulation_frequency: float | None) -> bool:
    """Return whether most of some large errors are whole unambiguous ranges.

    Not all: edges are some of them. Without errors, or without a frequency, they are not.

    Args:
        errors: Of pixels that are far off, any shape, metres.
        modulation_frequency: In Hz; None: unknown.
    """
    return 2 * int(wrapped(errors, modulation_frequency).sum()) > errors.size


def phase_from_radial_distance(radial_distance: Tensor, modulation_frequency: float) -> Tensor:
    """Return the phase 4 pi f D / c in radians, not wrapped."""
    return radial_distance * (2.0 * math.pi / unambiguous_range(modulation_frequency))


def _check_sizes(distances: Tensor, ray_directions: Tensor, name: str) -> None:
    if distances.shape[-2:] != ray_directions.shape[:2]:
        got = f"got {list(distances.shape[-2:])} and {list(ray_directions.shape[:2])}"
        why = "Were the rays built for another resolution or crop?"
        raise ValueError(f"{name} and ray_directions must share (H, W): {got}. {why}")


def multiples_in_words(size: float) -> str:
    """Return what errors by whole unambiguous ranges are off by; to follow "off by".

    Args:
        size: The unambiguous range, metres.
    """
    return f"{size:.2f} m or a multiple of it, the unambiguous range"
