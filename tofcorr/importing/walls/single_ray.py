r"""A sensor of one ray before named walls: ray, origin and walls from distances alone.

The sensor's ray b and origin t in the tool frame are unknown. At pose (R_i, p_i) it reads the
distance D_i to its wall, n . (R_i (D_i b + t) + p_i) + d = 0. For a given b the points
D_i R_i b + p_i lie nearly on planes if t is small, and t follows linearly; so b is looked for over
all directions.
"""

import math

import torch
from torch import Tensor

from tofcorr.estimation.objective import Parameters
from tofcorr.geometry import se3
from tofcorr.geometry.se3 import rotation_angle
from tofcorr.importing.walls.gathering import WallPlanes, points_in_world
from tofcorr.importing.walls.joint import Joint, corrected, fit_assigned
from tofcorr.importing.walls.seen_planes import SeenPlanes

# Directions of the grid: some 5 degrees apart.
_DIRECTIONS = 1_500
# Standard deviation of the sensor's origin in the tool frame before anything is known, metres,
# over that of a distance. Set by hand: the sensor sits on the tool.
_ORIGIN = 0.15 / 0.01
# How often walls and origin are fitted in turn for each direction of the grid. Set by hand: they
# only rank the directions.
_ALTERNATIONS = 12
# This many of the best directions are refined, none closer to a better one than this. Set by hand:
# neighbours on the grid are 5 degrees apart and lead to one fit.
_REFINED = 12
_APART = math.radians(6.0)
# A fit as good as the best, to this share: then the one nearest the guess is taken.
_AS_GOOD = 0.02


def match_single_ray(planes: SeenPlanes, guess: Tensor) -> Joint:
    """Find a one-pixel sensor's hand-eye and the walls it looked at.

    Args:
        planes: One point an image, its wall known by label.
        guess: A hand-eye transform (4, 4): it is tried, and decides what cannot be seen, which is
            the turn about the ray at least.
    """
    assert planes.label is not None
    ray = torch.nn.functional.normalize(planes.points[0, 0], dim=0)
    along = torch.cat([(guess[:3, :3] @ ray)[None], _directions(_DIRECTIONS)])
    loss, origin, normal, offset = _alternate(planes, along, guess[:3, 3])
    best = _distinct(along, loss)
    fits = []
    for k in best.tolist():
        rotation = _least_turn(guess[:3, :3] @ ray, along[k]) @ guess[:3, :3]
        start = se3.assemble(rotation, origin[k])
        fits.append(_fitted(planes, start, WallPlanes(normal[k], offset[k])))
    least = min(joint.cost() for joint in fits)
    good = [joint for joint in fits if joint.cost() <= (1 + _AS_GOOD) * least + 1e-9]
    return min(
        good,
        key=lambda joint: float(rotation_angle(guess[:3, :3].T @ joint.tool_from_camera[:3, :3])),
    )


def _alternate(
    planes: SeenPlanes, along: Tensor, guess: Tensor
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Fit walls and origin in turn for each direction (K, 3) of the ray.

    Returns:
        Mean squared deviations (K,), origins (K, 3), normals (K, G, 3) and offsets (K, G).
    """
    label = planes.label
    assert label is not None
    distance = planes.points[:, 0].norm(dim=1)
    member = torch.nn.functional.one_hot(label).to(torch.float64)
    share = member / member.sum(dim=0)
    hit = (
        planes.translation + distance[:, None] * (planes.rotation @ along[:, None, :, None])[..., 0]
    )
    origin = guess.expand(len(along), 3)
    normal = offset = left = torch.zeros(0)
    for _ in range(_ALTERNATIONS):
        points = hit + (planes.rotation @ origin[:, None, :, None])[..., 0]
        mean = torch.einsum("mg,kma->kga", share, points)
        centred = points - mean[:, label]
        second = torch.einsum("mg,kma,kmb->kgab", share, centred, centred)
        normal = torch.linalg.eigh(second).eigenvectors[..., 0]
        own = normal[:, label]
        # With the normals fixed, origin and offsets are linear; offsets are means.
        lever = (own[:, :, None, :] @ planes.rotation)[:, :, 0]
        lever = lever - torch.einsum("mg,kma->kga", share, lever)[:, label]
        part = (own * hit).sum(dim=2)
        part = part - torch.einsum("mg,km->kg", share, part)[:, label]
        hessian = lever.transpose(1, 2) @ lever + torch.eye(3).double() / _ORIGIN**2
        right = (lever * part[:, :, None]).sum(dim=1) - guess / _ORIGIN**2
        origin = -torch.linalg.solve(hessian, right[:, :, None])[:, :, 0]
        left = (part + (lever * origin[:, None]).sum(dim=2)).square().mean(dim=1)
    points = hit + (planes.rotation @ origin[:, None, :, None])[..., 0]
    mean = torch.einsum("mg,kma->kga", share, points)
    offset = -(normal * mean).sum(dim=2)
    # Normals on the sensor's side: it stands at a positive distance.
    sensor = planes.translation + (planes.rotation @ origin[:, None, :, None])[..., 0]
    height = torch.einsum("mg,kma,kga->kg", share, sensor, normal) + offset
    side = torch.where(height < 0, -1.0, 1.0)
    return left, origin, normal * side[..., None], offset * side


def _fitted(planes: SeenPlanes, tool_from_camera: Tensor, walls: WallPlanes) -> Joint:
    assert planes.label is not None
    start = Parameters(tool_from_camera, torch.zeros(2, dtype=torch.float64))
    parameters, walls = fit_assigned(planes, planes.label, start, walls, tool_from_camera)
    points = points_in_world(corrected(planes, parameters), parameters.tool_from_camera)
    off = (points[:, 0] * walls.normal[planes.label]).sum(dim=1) + walls.offset[planes.label]
    return Joint(parameters, walls, planes.label, off.abs())


def _distinct(along: Tensor, loss: Tensor) -> Tensor:
    """Return the directions of least loss, no two of them close."""
    left = loss.clone()
    found: list[int] = []
    while len(found) < _REFINED and bool(left.isfinite().any()):
        best = int(left.argmin())
        found.append(best)
        left[along @ along[best] > math.cos(_APART)] = torch.inf
    return torch.tensor(found)


def _directions(number: int) -> Tensor:
    """Return directions spread evenly: a Fibonacci lattice, shape (K, 3)."""
    place = torch.arange(number, dtype=torch.float64) + 0.5
    z = 1 - 2 * place / number
    angle = math.pi * (1 + math.sqrt(5.0)) * place
    radius = (1 - z.square()).sqrt()
    return torch.stack([radius * angle.cos(), radius * angle.sin(), z], dim=1)


def _least_turn(first: Tensor, second: Tensor) -> Tensor:
    """Return the smallest rotation that takes one unit vector to another, shape (3, 3)."""
    axis = torch.linalg.cross(first, second)
    cosine = float(first @ second)
    if float(axis.norm()) < 1e-9:
        if cosine > 0:
            return torch.eye(3, dtype=torch.float64)
        helper = torch.eye(3, dtype=torch.float64)[int(first.abs().argmin())]
        axis = torch.linalg.cross(first, helper)
    angle = math.atan2(float(torch.linalg.cross(first, second).norm()), cosine)
    twist = torch.cat([torch.zeros(3).double(), angle * torch.nn.functional.normalize(axis, dim=0)])
    return se3.exp(twist)[:3, :3]
