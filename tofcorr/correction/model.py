"""Everything that a calibration fits: the error model and the camera's pose on the robot's tool."""

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor, nn

from tofcorr.error_terms.model import ErrorModel
from tofcorr.geometry import se3
from tofcorr.geometry.se3 import product, projected

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


class CalibrationModel(nn.Module):
    r"""The error model and the hand-eye transform, and the residual to a known plane.

    .. math:: \rho_v = n^\top \left(R\, a_v (D_v - E_v) + t\right) + e

    with :math:`a_v` the unit ray of the pixel, :math:`(R, t)` = tool_from_camera and the plane
    :math:`n^\top x + e = 0` in tool coordinates (Abdo and Borgeat 2010).

    Args:
        error: Predicted error of every pixel, metres along the ray.
        hand_eye: tool_from_camera.
    """

    def __init__(self, error: ErrorModel, hand_eye: HandEye) -> None:
        super().__init__()
        self.error = error
        self.hand_eye = hand_eye

    def residual(
        self,
        radial_distance: Tensor,
        amplitude: Tensor | None,
        ray_directions: Tensor,
        normal_tool: Tensor,
        offset_tool: Tensor,
        conditions: Tensor | None = None,
    ) -> Tensor:
        """Return the signed distance of every corrected point to its plane.

        This is the reference: autograd over pixels. It is differentiable in the error
        coefficients and the twist of the hand-eye.

        Args:
            radial_distance: Measured distances, shape (B, H, W), metres.
            amplitude: Amplitudes, shape (B, H, W); None if the model does not depend on them.
            ray_directions: Unit rays in the camera frame, shape (H, W, 3).
            normal_tool: Unit normals in the tool frame, shape (B, 3).
            offset_tool: Offsets of the planes in the tool frame, shape (B,), metres.
            conditions: The frames' conditions, shape (B, C); None: the mean conditions.

        Returns:
            Distances to the plane, shape (B, H, W), metres; positive on the normal's side.

        Raises:
            ValueError: The model depends on the amplitude and got none.
        """
        if amplitude is None:
            if self.error.needs_amplitude():
                raise ValueError("The error model has an amplitude term: expected amplitudes.")
            amplitude = radial_distance
        corrected = radial_distance - self.error(radial_distance, amplitude, conditions)
        return distance_to_plane(
            corrected, ray_directions, normal_tool, offset_tool, self.hand_eye()
        )


def distance_to_plane(
    radial_distance: Tensor,
    ray_directions: Tensor,
    normal_tool: Tensor,
    offset_tool: Tensor,
    tool_from_camera: Tensor,
) -> Tensor:
    """Return the signed distance of points, given by their distance along the ray, to a plane.

    Args:
        radial_distance: Shape (B, H, W), metres.
        ray_directions: Unit rays in the camera frame, shape (H, W, 3).
        normal_tool: Unit normals in the tool frame, shape (B, 3).
        offset_tool: Offsets of the planes in the tool frame, shape (B,), metres.
        tool_from_camera: The hand-eye transform, shape (4, 4).

    Returns:
        Shape (B, H, W), metres; positive on the side to which the normal points.
    """
    normal_camera = product(normal_tool, tool_from_camera[:3, :3])
    cosine = projected(ray_directions, normal_camera)
    origin_to_plane = (normal_tool * tool_from_camera[:3, 3]).sum(-1) + offset_tool
    return cosine * radial_distance + origin_to_plane[:, None, None]


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
