"""What poses and planes leave open of hand-eye and walls, by name."""

import torch
from torch import Tensor

from tofcorr.estimation.objective import HAND_EYE_SYMBOLS
from tofcorr.estimation.planes import Walls, joint_image_equations
from tofcorr.estimation.uncertainty import PRIOR_SIGMA
from tofcorr.importing.walls.joint import TYPICAL, Joint, held_error, point_moments
from tofcorr.importing.walls.seen_planes import SeenPlanes

# Components of a direction that are named, relative to the largest. Set by hand: smaller ones make
# the sentence long and say little.
_NAMED = 0.2
_ERROR = ["constant error", "slope of the error"]


def undetermined(planes: SeenPlanes, joint: Joint, names: list[str]) -> list[str]:
    """Name the directions of hand-eye and walls that the planes do not determine.

    A direction is undetermined if the planes, each known to 10 mm, say less about it than a prior
    of 100 mm and 100 mrad.

    Args:
        planes: The planes of all images.
        joint: The fit.
        names: The walls' names.
    """
    chosen = joint.wall >= 0
    if not bool(chosen.any()):
        return ["everything: no wall was found"]
    planes = planes.take(chosen)
    walls = Walls(
        joint.walls.normal, joint.walls.offset, joint.wall[chosen], planes.world_from_tool
    )
    moments = walls.seen_by(point_moments(planes))
    each = joint_image_equations(moments, joint.parameters, walls)
    precision = each.hessian.sum(dim=0) / TYPICAL**2
    size = joint.parameters.size
    precision[:size, :size] += held_error() / TYPICAL**2
    symbols = [f"{symbol} of the hand-eye" for symbol in HAND_EYE_SYMBOLS] + _ERROR
    for name in names:
        symbols += [f"the tilt of {name}", f"the tilt of {name}", f"the distance of {name}"]
    return _named(_open_directions(precision), symbols)


def _open_directions(precision: Tensor) -> Tensor:
    """Return an orthonormal basis (P, F) of what the prior determines more than the planes do."""
    prior = torch.eye(len(precision), dtype=precision.dtype) / PRIOR_SIGMA**2
    variance, vectors = torch.linalg.eigh(torch.linalg.inv(precision + prior))
    return vectors[:, variance > 0.5 * PRIOR_SIGMA**2]


def _named(basis: Tensor, symbols: list[str]) -> list[str]:
    """Turn a basis into one whose directions concern few unknowns, and name those."""
    left, found = basis, []
    for _ in range(basis.shape[1]):
        inside = left @ left.T
        vector = inside[:, int(inside.diagonal().argmax())]
        vector = vector / vector.norm()
        left = left - vector[:, None] * (vector @ left)
        size = vector.abs()
        order = [k for k in size.argsort(descending=True).tolist() if size[k] > _NAMED * size.max()]
        found.append(" against ".join(dict.fromkeys(symbols[k] for k in order)))
    return list(dict.fromkeys(found))
