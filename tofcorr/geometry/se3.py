"""Rigid transforms as 4x4 matrices, their exponential map, and products of small matrices.

torch computes a matrix product of float32 in fewer digits where a program asks for speed: by
`torch.autocast`, or by `torch.set_float32_matmul_precision("high")` on a GPU. For a network that is
well; a point a metre away moves by a millimetre, or by a centimetre. Sums of products are left as
they are.
"""

from typing import Annotated

import numpy as np
import torch
from kornia.geometry.liegroup import Se3
from pydantic import AfterValidator
from torch import Tensor

from tofcorr.options import Number

UNIT_LENGTH_TOLERANCE = 1e-3
"""Largest difference from 1 of the length of a quaternion, a normal or a column of a rotation (no
unit): rounding to three digits. Part of the recording format, version 1."""


def product(left: Tensor, right: Tensor) -> Tensor:
    """Return the matrix product of small matrices, (..., N, K) and (..., K, M)."""
    return (left.unsqueeze(-1) * right.unsqueeze(-3)).sum(-2)


def by_frame(values: Tensor, matrices: Tensor, frame: Tensor) -> Tensor:
    """Multiply the values of each pixel by the matrix of its frame, shape (M, K).

    Args:
        values: Of the pixels, shape (M, J).
        matrices: Of the frames, shape (F, J, K).
        frame: Which frame a pixel belongs to, shape (M,), int64, in any order.
    """
    order = None if bool((frame.diff() >= 0).all()) else frame.argsort(stable=True)
    counts = torch.bincount(frame, minlength=len(matrices)).tolist()
    parts = (values if order is None else values[order]).split(counts)
    product = torch.cat([part @ own for part, own in zip(parts, matrices, strict=True)])
    return product if order is None else torch.empty_like(product).index_copy(0, order, product)


def exp(twist: Tensor) -> Tensor:
    """Return the rigid transform of a twist: the exponential of its matrix.

    Args:
        twist: Translational part first, metres and radians, shape (..., 6).

    Returns:
        Transforms, shape (..., 4, 4).
    """
    # In float64, whose products no program asks for in fewer digits.
    found = torch.linalg.matrix_exp(hat(twist).double()).to(twist)
    return assemble(found[..., :3, :3], found[..., :3, 3])


def _generators() -> Tensor:
    """Return the matrices that a twist's entries multiply, shape (6, 4, 4)."""
    generators = torch.zeros(6, 4, 4)
    for k, (a, b) in enumerate([(1, 2), (2, 0), (0, 1)]):
        generators[k, k, 3] = 1.0
        generators[3 + k, b, a], generators[3 + k, a, b] = 1.0, -1.0
    return generators


GENERATORS = _generators()
"""The matrices that the entries of a twist multiply, translations first, shape (6, 4, 4)."""


def hat(twist: Tensor) -> Tensor:
    """Return the matrices (..., 4, 4) of twists (..., 6)."""
    return (twist[..., None, None] * GENERATORS.to(twist)).sum(-3)


def vee(matrix: Tensor) -> Tensor:
    """Return the twists (..., 6) of matrices (..., 4, 4); inverse of `hat`."""
    shared = matrix[..., None, :, :] * GENERATORS.to(matrix)
    return shared.sum((-2, -1)) / GENERATORS.abs().sum((-2, -1)).to(matrix)


def small_motion(twist: Tensor) -> Tensor:
    """Return exp of twists (F, 6) to second order, shape (F, 4, 4).

    Exact to 1e-6 m at 10 cm, and to 1e-7 at 10 mrad.
    """
    matrix = hat(twist)
    return torch.eye(4).to(twist) + matrix + matrix @ matrix / 2


def log(transform: Tensor) -> Tensor:
    """Return the twist of a rigid transform; inverse of `exp` for rotations below pi.

    Args:
        transform: Rigid transforms, shape (..., 4, 4).

    Returns:
        Twists, translational part first, shape (..., 6).
    """
    # kornia makes parameters of tensors: without a gradient unless the argument needs one.
    with torch.set_grad_enabled(torch.is_grad_enabled() and transform.requires_grad):
        twist = Se3.from_matrix(transform.reshape(-1, 4, 4)).log()
    return twist.reshape(*transform.shape[:-2], 6)


def log_slope(twist: Tensor) -> Tensor:
    r"""Return the derivative of log(exp(twist) exp(step)) by the step at zero, shape (6, 6).

    It is the inverse of :math:`\int_0^1 e^{-s\,\mathrm{ad}}\,ds`, ad being the twist's commutator
    (Barfoot 2017, section 7.1.5).

    Args:
        twist: Translation and rotation, shape (6,).
    """
    axes = torch.eye(3).to(twist)
    shift, turn = (torch.linalg.cross(part.expand(3, 3), axes).T for part in twist.split(3))
    commutator = torch.cat([torch.cat([turn, shift], 1), torch.cat([0 * turn, turn], 1)])
    corner = torch.cat([-commutator, torch.eye(6).to(twist)], dim=1)
    return torch.linalg.inv(torch.matrix_exp(torch.nn.functional.pad(corner, (0, 0, 0, 6)))[:6, 6:])


def inverse(transform: Tensor) -> Tensor:
    """Return the inverse of rigid transforms of shape (..., 4, 4)."""
    rotation_t = transform[..., :3, :3].transpose(-1, -2)
    translation = -(rotation_t @ transform[..., :3, 3:])
    return assemble(rotation_t, translation[..., 0])


def assemble(rotation: Tensor, translation: Tensor) -> Tensor:
    """Build transforms (..., 4, 4) from rotations (..., 3, 3) and translations (..., 3)."""
    top = torch.cat([rotation, translation[..., None]], dim=-1)
    bottom = top.new_tensor([0.0, 0.0, 0.0, 1.0]).expand(*top.shape[:-2], 1, 4)
    return torch.cat([top, bottom], dim=-2)


def world_from_plane(normal: Tensor, offset: Tensor) -> Tensor:
    """Return the frames of planes: x and y are in the plane, z is the normal.

    The origin is the point of the plane nearest to the origin of the world. x is the world's x axis
    projected onto the plane (the world's y axis if x is nearly parallel to the normal). So the
    plane of a recording alone determines where the squares are.

    Args:
        normal: Unit normals n, shape (..., 3).
        offset: d in n . x + d = 0, shape (...), metres.

    Returns:
        Rigid transforms, shape (..., 4, 4).
    """
    first, second, _ = torch.eye(3).to(normal)
    along = torch.where(normal[..., :1].abs() < 0.9, first, second)
    across = along - normal * (along * normal).sum(-1, keepdim=True)
    x = torch.nn.functional.normalize(across, dim=-1)
    rotation = torch.stack([x, torch.linalg.cross(normal, x), normal], dim=-1)
    return assemble(rotation, -offset[..., None] * normal)


def refuse_unless_rigid(matrix: np.ndarray, tolerance: float = UNIT_LENGTH_TOLERANCE) -> None:
    """Refuse a matrix that is not a finite rigid transform of shape (4, 4).

    Args:
        matrix: What should be one.
        tolerance: Largest difference from 1 of the length of a column of the rotation (no unit).

    Raises:
        ValueError: It is not; the message says why.
    """
    if matrix.shape != (4, 4) or not np.isfinite(matrix).all():
        raise ValueError("expected a 4x4 matrix of finite numbers")
    if np.any(matrix[3] != [0, 0, 0, 1]):
        raise ValueError("the last row of a rigid transform is 0 0 0 1")
    rotation = matrix[:3, :3]
    # Entries above 2 cannot belong to a rotation, and their squares may overflow.
    small = np.abs(rotation).max() <= 2
    if not small or np.abs(rotation @ rotation.T - np.eye(3)).max() > 2 * tolerance:
        said = f"the upper left 3x3 block must be a rotation: orthonormal, to {tolerance:g}"
        raise ValueError(said)
    if np.linalg.det(rotation) < 0:
        raise ValueError("the upper left 3x3 block is a reflection, not a rotation")


Row4 = tuple[Number, Number, Number, Number]


def _rigid(rows: tuple[Row4, Row4, Row4, Row4]) -> tuple[Row4, Row4, Row4, Row4]:
    refuse_unless_rigid(np.array(rows))
    return rows


RigidTransform = Annotated[tuple[Row4, Row4, Row4, Row4], AfterValidator(_rigid)]
"""A rigid transform in a file, as four rows."""


def nearest_rigid(matrix: np.ndarray) -> np.ndarray:
    """Return the transform with its rotation made exact, shape (4, 4).

    Because of rounding in a file a rotation is only nearly orthonormal; the nearest rotation is
    returned.
    """
    left, _, right = np.linalg.svd(matrix[:3, :3])
    exact = matrix.copy()
    # What is exact but for the rounding of float64 stays as it is, to the last digit.
    if np.abs(left @ right - matrix[:3, :3]).max() > 1000 * np.finfo(np.float64).eps:
        exact[:3, :3] = left @ right
    return exact


def rotation_angle(rotation: Tensor) -> Tensor:
    """Return the angle of rotations (..., 3, 3) in radians, accurate near zero."""
    skew = rotation - rotation.transpose(-1, -2)
    sine = torch.stack([skew[..., 2, 1], skew[..., 0, 2], skew[..., 1, 0]], dim=-1).norm(dim=-1) / 2
    cosine = (rotation.diagonal(dim1=-2, dim2=-1).sum(-1) - 1) / 2
    return torch.atan2(sine, cosine)


def apart(one: Tensor, other: Tensor) -> tuple[float, float]:
    """Return the distance of two rigid transforms (4, 4), metres, and their angle, radians."""
    between = inverse(one.double()) @ other.double()
    return float(between[:3, 3].norm()), float(rotation_angle(between[:3, :3]))


def transformed(transform: Tensor, points: Tensor) -> Tensor:
    """Return points in another frame.

    Args:
        transform: Rigid, shape (4, 4), metres.
        points: Shape (..., 3), metres.

    Returns:
        The points, shape (..., 3), metres.
    """
    moved = transform[:3, 3]
    for axis in range(3):
        moved = moved + points[..., axis : axis + 1] * transform[:3, axis]
    return moved


def projected(vectors: Tensor, directions: Tensor) -> Tensor:
    """Return the scalar products of vectors (..., 3) with directions (B, 3), shape (B, ...)."""
    shape = [len(directions)] + [1] * (vectors.dim() - 1)
    total = vectors[..., 0] * directions[:, 0].reshape(shape)
    for axis in range(1, 3):
        total = total + vectors[..., axis] * directions[:, axis].reshape(shape)
    return total


def tool_twists(timestamp: Tensor, world_from_tool: Tensor) -> Tensor:
    """Return the tool's velocity in every frame, from a parabola through it and two near it.

    At the ends of a stroke both neighbours lie on one side.

    Args:
        timestamp: Of the frames, shape (F,), seconds.
        world_from_tool: Poses of the tool, shape (F, 4, 4).

    Returns:
        Twists in the tool's own frame, translation first, shape (F, 6), m/s and rad/s; NaN where a
        frame has no two others within reach, and everywhere if time does not increase.
    """
    count, gaps = len(timestamp), timestamp.diff()
    twists = timestamp.new_full((count, 6), torch.nan)
    # A robot starts and stops within a second (chosen): poses farther apart say nothing.
    stroke = torch.cat([gaps.new_zeros(1), (gaps > 1.0).cumsum(0)])
    for frame in range(count) if bool((gaps > 0).all()) else ():
        around = (frame - 1, frame + 1, frame - 2, frame + 2)
        near = [k for k in around if 0 <= k < count and stroke[k] == stroke[frame]][:2]
        if len(near) == 2:
            first, second = (timestamp[near] - timestamp[frame]).tolist()
            moved = log(inverse(world_from_tool[frame]) @ world_from_tool[near])
            twist = second / first * moved[0] - first / second * moved[1]
            twists[frame] = twist / (second - first)
    return twists
