r"""The rotation of the hand-eye under which normals seen from many poses coincide.

A wall of normal :math:`w` is seen by the camera at pose :math:`R_i` with the normal :math:`m` where
:math:`w = R_i X m`. Which planes show one wall is not known, nor is X. For the right X the turned
normals of all images gather in a few places; so X is looked for over all rotations, by how many
pairs of planes of different images agree.
"""

import math

import torch
from torch import Tensor

from tofcorr.importing.walls.seen_planes import SeenPlanes

# Rotations of the grid: some 9 degrees apart. Half of that is within reach of the refinement.
_GRID = 20_000
# Rotations scored at once: the cosines of 90 planes under so many (3 MB) stay in a processor's
# cache, which is four times as fast as 500.
_AT_ONCE = 100
# Normals that agree to within about this angle count as one wall's: coarse, and when refined. The
# fine one leaves room for the tilt that a camera's error gives a plane.
_COARSE = math.radians(14.0)
_FINE = math.radians(5.0)
_REFINEMENTS = 14
# This many of the grid's best are refined, none closer to a better one than this. Set by hand: the
# right rotation was among far fewer in simulated rooms, and a refinement reaches some 14 degrees.
_REFINED = 80
_APART = math.radians(15.0)
# The planes looked at: the pairs grow with their square.
_MOST_PLANES = 90
# Refined rotations under which normals are closer than this on average are one. Set by hand: less
# than the 5 degrees to which normals agree.
_SAME = math.radians(3.0)
# Rotations under which at least this share of the best one's pairs agree are kept. Set by hand: the
# places of the planes decide among them.
_WORTH_TRYING = 0.5
# Keeps a division defined where no pair counts: far below the weight of any pair.
_BLAND = 1e-9


def candidate_rotations(planes: SeenPlanes, guesses: Tensor) -> Tensor:
    """Return rotations tool_from_camera that make normals coincide, the best first.

    Args:
        planes: The planes of all images.
        guesses: Rotations to try besides those of the grid, shape (G, 3, 3).

    Returns:
        Rotations (K, 3, 3), the best first: those under which at least half as many pairs agree as
        under the best, no two of which put the normals into the same directions.
    """
    pair = _pair_weights(planes)
    grid = torch.cat([guesses, rotation_grid(_GRID)])
    score = torch.cat([_score(planes, pair, part, _COARSE) for part in grid.split(_AT_ONCE)])
    # Guesses are always refined.
    score[: len(guesses)] = torch.inf
    rotations = _refined(planes, pair, grid[_peaks(grid, score, _APART, _REFINED)])
    score = _score(planes, pair, rotations, _FINE)
    order = score.argsort(descending=True, stable=True)
    order = order[score[order] >= _WORTH_TRYING * score.max()]
    return _distinct(planes, rotations[order])


def _distinct(planes: SeenPlanes, rotations: Tensor) -> Tensor:
    """Drop rotations that turn the normals as a better one does: a turn that the images cannot see.

    The first rotation of each kind stays; guesses come before others that are as good.
    """
    normal = _turned(planes, rotations)
    kept: list[int] = []
    for k in range(len(rotations)):
        apart = (normal[kept] - normal[k]).norm(dim=2).mean(dim=1)
        if not bool((apart < _SAME).any()):
            kept.append(k)
    return rotations[kept]


def rotation_grid(number: int) -> Tensor:
    """Return rotations spread evenly: a super-Fibonacci spiral (Alexa 2022), shape (K, 3, 3)."""
    # The constants of the paper: the square root of 2 and the real root of p^4 = p + 4.
    phi, psi = math.sqrt(2.0), 1.533751168755204288118041
    s = torch.arange(number, dtype=torch.float64) + 0.5
    r, big_r = (s / number).sqrt(), (1 - s / number).sqrt()
    a, b = 2 * math.pi * s / phi, 2 * math.pi * s / psi
    x, y, z, w = r * a.sin(), r * a.cos(), big_r * b.sin(), big_r * b.cos()
    rows = [
        *(1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)),
        *(2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)),
        *(2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)),
    ]
    return torch.stack(rows, dim=-1).unflatten(-1, (3, 3))


def varied(planes: SeenPlanes) -> SeenPlanes:
    """Return at most 90 planes, of images whose robot poses are turned as differently as can be."""
    if len(planes) <= _MOST_PLANES:
        return planes
    _, first, count = _of_images(planes.image)
    rotation = planes.rotation[first].flatten(1)
    distance = (rotation - rotation[0]).square().sum(dim=1)
    chosen, total = [0], int(count[0])
    while total < _MOST_PLANES:
        following = int(distance.argmax())
        if following in chosen:
            # All poses that differ are in: fill up in order.
            following = next(k for k in range(len(first)) if k not in chosen)
        chosen.append(following)
        total += int(count[following])
        distance = distance.minimum((rotation - rotation[following]).square().sum(dim=1))
    images = planes.image[first[torch.tensor(chosen)]]
    return planes.take(torch.isin(planes.image, images))


def _of_images(image: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return the images in the planes' order, where each begins, and how many planes it has."""
    numbers, count = torch.unique_consecutive(image, return_counts=True)
    return numbers, count.cumsum(0) - count, count


def _pair_weights(planes: SeenPlanes) -> Tensor:
    """Return what a pair of planes counts, shape (M, M): nothing if it cannot be one wall."""
    weight = planes.support.sqrt()
    return torch.where(planes.may_be_one_wall(), weight[:, None] * weight[None, :], 0.0)


def _score(planes: SeenPlanes, pair: Tensor, rotations: Tensor, width: float) -> Tensor:
    """Return the share of pairs that agree under each rotation, shape (K,)."""
    normal = _turned(planes, rotations).to(torch.float32)
    # The Gaussian of an angle, through its cosine: falls to 1 / e at the width.
    steep = 1 / (1 - math.cos(width))
    agree = torch.baddbmm(torch.tensor(-steep), normal, normal.transpose(1, 2), alpha=steep).exp_()
    counted = agree.flatten(1) @ pair.to(torch.float32).flatten()
    return counted.double() / pair.sum().clamp(min=_BLAND)


def _turned(planes: SeenPlanes, rotations: Tensor) -> Tensor:
    """Return the normals in the world under each rotation, shape (K, M, 3)."""
    return torch.einsum("mab,kbc,mc->kma", planes.rotation, rotations, planes.normal)


def _peaks(rotations: Tensor, score: Tensor, apart: float, most: int) -> Tensor:
    """Return the best rotations none of which is close to a better one."""
    left, flat = score.clone(), rotations.flatten(1)
    # The trace of a rotation by an angle a is 1 + 2 cos a.
    close = 1 + 2 * math.cos(apart)
    found = []
    while len(found) < most:
        best = int(left.argmax())
        if left[best] == -torch.inf:
            break
        found.append(best)
        left[flat @ flat[best] > close] = -torch.inf
        left[best] = -torch.inf
    return torch.tensor(found)


def _refined(planes: SeenPlanes, pair: Tensor, rotations: Tensor) -> Tensor:
    """Bring pairs that nearly agree closer together, from wide to narrow (Gauss-Newton).

    A pair's weight falls with its angle, so that planes of different walls do not pull.
    """
    for step in range(_REFINEMENTS):
        share = min(1.0, step / (_REFINEMENTS - 4))
        width = _COARSE * (_FINE / _COARSE) ** share
        normal = _turned(planes, rotations)
        cosine = normal @ normal.transpose(1, 2)
        weight = pair * ((cosine - 1) / (1 - math.cos(width))).exp()
        # A turn d of the camera moves R X m by -R X [m] d; the sum over pairs is a Laplacian.
        jacobian = -(planes.rotation @ (rotations[:, None] @ _skew(planes.normal)))
        total = weight.sum(dim=2)
        apart = total[:, :, None] * normal - weight @ normal
        spread = total[:, :, None, None] * jacobian - (weight @ jacobian.flatten(2)).unflatten(
            2, (3, 3)
        )
        hessian = torch.einsum("kmab,kmac->kbc", jacobian, spread)
        gradient = torch.einsum("kmab,kma->kb", jacobian, apart)
        # Where the poses say nothing of a turn, none is made.
        ridge = 1e-3 * hessian.diagonal(dim1=1, dim2=2).sum(dim=1) + _BLAND
        damped = hessian + ridge[:, None, None] * torch.eye(3, dtype=hessian.dtype)
        turn = -torch.linalg.solve(damped, gradient[:, :, None])[:, :, 0]
        turn = turn * (_COARSE / turn.norm(dim=1, keepdim=True).clamp(min=_COARSE))
        rotations = rotations @ torch.linalg.matrix_exp(_skew(turn))
    return rotations


def _skew(vector: Tensor) -> Tensor:
    """Return the matrices of the cross product from the left, shape (..., 3, 3)."""
    x, y, z = vector.unbind(-1)
    zero = torch.zeros_like(x)
    return torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], dim=-1).unflatten(-1, (3, 3))
