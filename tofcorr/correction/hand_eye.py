"""The camera's pose on the robot's tool."""

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor, nn

from tofcorr.geometry import se3
from tofcorr.geometry.se3 import product

# Largest deviation of R^T R from the identity (no unit). More than that is a mistake rather than
# rounding: float32 rounds to 1e-7.
_RIGIDITY_TOLERANCE = 1e-6


class HandEye(nn.Module):
    r"""A rigid transform near an initial guess, optimised without constraints.

    .. math:: T_\mathrm{tool \leftarrow camera} = T_0 \exp(\hat\xi)

    The twist :math:`\xi` starts at zero, so training starts at the guess, and any value an
    optimiser writes into it is a valid rotation and translation.

    Args:
        start: The guess T_0, shape (4, 4), metres; the identity when not given.
        fixed: Whether the transform is known and stays as it is.

    Raises:
        ValueError: `start` is not a rigid transform.

    Attributes:
        start: T_0, a buffer of shape (4, 4), float64.
        twist: The parameter, shape (6,), translational part first, metres and radians, float64.
    """

    start: Tensor

    def __init__(
        self,
        start: Tensor | np.ndarray | Sequence[Sequence[float]] | None = None,
        *,
        fixed: bool = False,
    ) -> None:
        super().__init__()
        self.register_buffer("start", _rigid(torch.eye(4) if start is None else start))
        self.twist = nn.Parameter(torch.zeros(6, dtype=torch.float64), requires_grad=not fixed)

    @property
    def fixed(self) -> bool:
        """Whether the transform is known and not estimated."""
        return not self.twist.requires_grad

    def forward(self) -> Tensor:
        """Return tool_from_camera, shape (4, 4)."""
        return product(self.start, se3.exp(self.twist))

    @torch.no_grad()
    def rebase(self, transform: Tensor | np.ndarray | Sequence[Sequence[float]]) -> None:
        """Set the transform (4, 4): it becomes `start`, and the twist becomes zero."""
        self.start.copy_(_rigid(transform))
        self.twist.zero_()


def _rigid(transform: Tensor | np.ndarray | Sequence[Sequence[float]]) -> Tensor:
    """Return a float64 copy of `transform`, after checking that it is rigid."""
    matrix = torch.as_tensor(transform, dtype=torch.float64).detach().clone()
    if matrix.shape != (4, 4):
        raise ValueError(f"A hand-eye transform has shape (4, 4), got {tuple(matrix.shape)}.")
    rotation = matrix[:3, :3]
    bottom = matrix.new_tensor([0.0, 0.0, 0.0, 1.0])
    apart = (rotation.T @ rotation - torch.eye(3).to(matrix)).abs().max()
    proper = apart < _RIGIDITY_TOLERANCE and torch.det(rotation) > 0
    if not (matrix.isfinite().all() and proper and torch.equal(matrix[3], bottom)):
        raise ValueError(
            "A hand-eye transform is a rotation and a translation over the row (0, 0, 0, 1), "
            f"got {matrix.tolist()}."
        )
    return matrix
