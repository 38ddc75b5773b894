r"""Walls estimated alone, hand-eye and error model being known: no start is needed.

An image's moments hold the sum over its corrected points :math:`x` of :math:`(x, 1)(x, 1)^T`.
Summed in the world over all images of one wall, the plane of least squared distances passes through
the mean of the points, along the direction in which they spread least.
"""

import torch
from torch import Tensor

from tofcorr.estimation.moments import ImageMoments
from tofcorr.estimation.parameters import Parameters
from tofcorr.estimation.planes import Walls


def estimate_walls_alone(
    moments: ImageMoments, parameters: Parameters, index: Tensor, world_from_tool: Tensor
) -> Walls:
    """Return the walls of least squared distances under a known calibration.

    Args:
        moments: Of the images; the planes they were recorded with are not looked at.
        parameters: Hand-eye transform and coefficients.
        index: The wall of each image, counted from zero without a gap, shape (N,).
        world_from_tool: The pose of each image, shape (N, 4, 4).
    """
    pose = world_from_tool @ parameters.tool_from_camera
    points = pose @ _point_moments(moments, parameters) @ pose.transpose(1, 2)
    count = int(index.max()) + 1
    total = points.new_zeros(count, 4, 4).index_add_(0, index, points)
    mean = total[:, :3, 3] / total[:, 3:, 3]
    spread = total[:, :3, :3] / total[:, 3:, 3:] - mean[:, :, None] * mean[:, None, :]
    normal = torch.linalg.eigh(spread).eigenvectors[:, :, 0]
    offset = -(normal * mean).sum(dim=1)
    # Towards the cameras: most of them stand on the positive side.
    height = (pose[:, :3, 3] * normal[index]).sum(dim=1) + offset[index]
    side = height.new_zeros(count).index_add_(0, index, height)
    sign = torch.where(side < 0, -1.0, 1.0).to(normal)
    return Walls(normal * sign[:, None], offset * sign, index, world_from_tool)


def _point_moments(moments: ImageMoments, parameters: Parameters) -> Tensor:
    """Return the sums of (x, 1)(x, 1)^T over corrected points in the camera frame, (N, 4, 4)."""
    size = moments.gram.shape[-1]
    columns = torch.cat([parameters.coefficients.new_ones(1), -parameters.coefficients])
    combine = moments.gram.new_zeros(4, size)
    for axis in range(3):
        combine[axis, axis : size - 1 : 3] = columns
    combine[3, -1] = 1.0
    return combine @ moments.gram @ combine.T
