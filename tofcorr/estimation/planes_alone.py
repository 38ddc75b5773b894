r"""Planes through points that are known: no start is needed.

The points :math:`x` of one plane enter through the sum of :math:`(x, 1)(x, 1)^T`. The plane of
least squared distances passes through their mean, along the direction in which they spread least.
"""

import torch
from jaxtyping import Float
from torch import Tensor


def plane_through(
    points: Float[Tensor, "4 4"], viewpoint: Float[Tensor, "3"]
) -> tuple[Float[Tensor, "3"], Float[Tensor, ""]]:
    """Return the plane n . x + d = 0 of least squared distances.

    Args:
        points: Sum of (x, 1)(x, 1)^T over the points, shape (4, 4), metres.
        viewpoint: A point that the normal shall face, shape (3,).

    Returns:
        The unit normal (3,) and the offset d (), metres.
    """
    mean = points[:3, 3] / points[3, 3]
    spread = points[:3, :3] / points[3, 3] - mean[:, None] * mean[None, :]
    normal = torch.linalg.eigh(spread).eigenvectors[:, 0]
    normal = torch.where(normal @ (viewpoint - mean) < 0, -normal, normal)
    return normal, -(normal @ mean)
