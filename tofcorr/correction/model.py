"""Everything that a calibration fits: the error model and the hand-eye transform."""

from torch import Tensor, nn

from tofcorr.correction.hand_eye import HandEye
from tofcorr.error_terms.model import ErrorModel
from tofcorr.geometry.se3 import product, projected


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
