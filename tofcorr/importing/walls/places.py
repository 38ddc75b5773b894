r"""The translation of the hand-eye under which planes of one direction fall into one place.

With the rotation X known, the middle :math:`x` of a plane lies in the world at
:math:`R_i (X x + t) + p_i`. Along the wall's normal w two images of one wall agree, which is linear
in the translation t; two parallel walls disagree by their distance. So t is found from pairs of
images, by how many of them agree.
"""

import math

import numpy as np
import torch
from torch import Tensor

from tofcorr.importing.walls.seen_planes import SeenPlanes

# Normals of the world closer than this are of one direction: the tilt that a camera's error gives
# a plane, twice.
_ONE_DIRECTION = math.radians(8.0)
# Translations the search starts from, along each axis, metres: what tools and brackets measure.
_STARTS = (-0.25, 0.0, 0.25)
# How near two places of one wall are, metres: at first, when the translation is open, and last,
# with the camera's error alone.
_WIDE, _NARROW = 0.4, 0.03
_REFINEMENTS = 12
# Standard deviation of a translation before anything is known of it, metres: tools and brackets
# rarely measure more.
_USUAL = 0.3
# An agreement as good as the best, to this share: then the start nearest the guess is taken.
_AS_GOOD = 0.02


def candidate_translation(
    planes: SeenPlanes, rotation: Tensor, guess: Tensor
) -> tuple[Tensor, float]:
    """Find the translation tool_from_camera under which most pairs of planes agree.

    Args:
        planes: The planes of all images.
        rotation: The rotation tool_from_camera, shape (3, 3).
        guess: A translation, shape (3,): what the images leave open stays near it.

    Returns:
        The translation (3,) in metres, and how many pairs agree, counted by their size.
    """
    direction = wall_directions(planes, rotation)
    middle = planes.points.mean(dim=1) @ rotation.T
    place = (planes.rotation @ middle[:, :, None])[:, :, 0] + planes.translation
    along = (direction * place).sum(dim=1)
    lever = (planes.rotation.transpose(1, 2) @ direction[:, :, None])[:, :, 0]
    same = direction @ direction.T > 1 - 1e-9
    pair = (same & planes.may_be_one_wall()).triu().nonzero()
    first, second = pair[:, 0], pair[:, 1]
    if not len(pair):
        return guess, 0.0
    weight = (planes.support[first] * planes.support[second]).sqrt()
    apart, slope = along[first] - along[second], lever[first] - lever[second]
    starts = guess + torch.cartesian_prod(*[torch.tensor(_STARTS).double()] * 3)
    found, score = _agreed(apart, slope, weight, starts, guess)
    good = score >= (1 - _AS_GOOD) * score.max()
    best = int((found[good] - guess).norm(dim=1).argmin())
    return found[good][best], float(score[good][best])


def _agreed(
    apart: Tensor, slope: Tensor, weight: Tensor, starts: Tensor, guess: Tensor
) -> tuple[Tensor, Tensor]:
    """Refine translations (K, 3) from wide to narrow; return them and the weight that agrees."""
    found = starts
    prior = torch.eye(3, dtype=torch.float64) * (_NARROW / _USUAL) ** 2 * weight.mean()
    for step in range(_REFINEMENTS):
        share = min(1.0, step / (_REFINEMENTS - 4))
        width = _WIDE * (_NARROW / _WIDE) ** share
        off = apart + found @ slope.T
        agree = weight * (-(off / width).square()).exp()
        hessian = torch.einsum("kp,pa,pb->kab", agree, slope, slope) + prior
        right = torch.einsum("kp,pa->ka", agree * apart, slope) - prior @ guess
        found = -torch.linalg.solve(hessian, right[:, :, None])[:, :, 0]
    off = apart + found @ slope.T
    return found, (-(off / _NARROW).square()).exp() @ weight


def wall_directions(planes: SeenPlanes, rotation: Tensor) -> Tensor:
    """Return for each plane the mean normal in the world of those of its direction, (M, 3)."""
    # NumPy: thousands of steps over a few dozen planes, where a call's own cost is all there is.
    normal = (planes.rotation @ (planes.normal @ rotation.T)[:, :, None])[:, :, 0].numpy()
    support = planes.support.numpy()
    direction = normal.copy()
    left = np.ones(len(planes), dtype=bool)
    close = math.cos(_ONE_DIRECTION)
    near = (normal @ normal.T > close) * support
    while left.any():
        centre = normal[np.where(left, near @ left, -1.0).argmax()]
        for _ in range(3):
            total = (support * (left & (normal @ centre > close))) @ normal
            centre = total / max(math.sqrt(total @ total), 1e-12)
        members = left & (normal @ centre > close)
        if not members.any():
            break
        direction[members] = centre
        left &= ~members
    return torch.from_numpy(direction)
