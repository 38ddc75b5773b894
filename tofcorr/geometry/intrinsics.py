"""The camera intrinsics."""

from dataclasses import dataclass

import torch
from torch import Tensor

Matrix3 = tuple[tuple[float, float, float], tuple[float, float, float], tuple[float, float, float]]


@dataclass(frozen=True, kw_only=True)
class CameraIntrinsics:
    """Image size, pinhole matrix and lens distortion.

    Attributes:
        width: Columns of the image.
        height: Rows of the image.
        matrix: The 3x3 pinhole matrix in pixels, pixel centres at integer coordinates.
        distortion: OpenCV's coefficients k1 k2 p1 p2 [k3 [k4 k5 k6 [...]]]; empty for none.
    """

    width: int
    height: int
    matrix: Matrix3
    distortion: tuple[float, ...] = ()

    def matrix_tensor(self) -> Tensor:
        """Return the pinhole matrix, shape (3, 3), float64."""
        return torch.tensor(self.matrix, dtype=torch.float64)
