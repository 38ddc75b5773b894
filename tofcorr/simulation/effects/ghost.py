"""The ghost of an image: light that lens and sensor threw back and forth."""

import torch
from torch import Tensor
from torch.nn.functional import grid_sample

from tofcorr.geometry.intrinsics import CameraIntrinsics


def ghost(images: Tensor, camera: CameraIntrinsics, size: float) -> Tensor:
    """Return complex images (F, H, W) turned half round about the optical axis and made smaller.

    Outside the ghost, and where it shows what the image does not hold, it is dark.

    Args:
        images: Phasors.
        camera: Where the optical axis meets the image.
        size: Of the ghost, over that of the image.
    """
    height, width = images.shape[-2:]
    matrix = camera.matrix_tensor()
    row = torch.arange(height, dtype=torch.float64)
    column = torch.arange(width, dtype=torch.float64)
    y = matrix[1, 2] - (row - matrix[1, 2]) / size
    x = matrix[0, 2] - (column - matrix[0, 2]) / size
    # Places from -1 to 1 between the centres of the outermost pixels.
    y, x = 2 * y / max(height - 1, 1) - 1, 2 * x / max(width - 1, 1) - 1
    places = torch.stack(torch.meshgrid(x, y, indexing="xy"), dim=-1)
    parts = torch.view_as_real(images).movedim(-1, 1)
    turned = grid_sample(
        parts,
        places.to(parts.dtype).expand(len(parts), *places.shape),
        mode="bilinear",
        padding_mode="zeros",
        align_corners=True,
    )
    return torch.view_as_complex(turned.movedim(1, -1).contiguous())
