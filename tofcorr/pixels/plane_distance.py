"""How far a model leaves the points of a batch of frames from their planes."""

import torch
from jaxtyping import Float
from torch import Tensor

from tofcorr.correction.model import CalibrationModel
from tofcorr.data.frames import FrameBatch


def distance_to_plane(
    model: CalibrationModel, batch: FrameBatch, ray_directions: Float[Tensor, "H W 3"]
) -> Float[Tensor, "B H W"]:
    """Return the signed distance of every corrected point to its plane.

    Pixels that are not valid are read as 1 m and amplitude 1, so that no NaN reaches the model.

    Args:
        model: Corrects the distances; its parameters get no gradient.
        batch: The frames.
        ray_directions: Unit rays in the camera frame, shape (H, W, 3).

    Returns:
        Shape (B, H, W), metres, positive on the normal's side; meaningless where not valid.
    """
    distance = torch.where(batch.valid, batch.radial_distance, 1.0)
    amplitude = batch.amplitude
    if amplitude is not None:
        amplitude = torch.where(batch.valid, amplitude, 1.0)
    with torch.no_grad():
        return model.residual(
            distance,
            amplitude,
            ray_directions,
            batch.normal_tool,
            batch.offset_tool,
            batch.conditions,
        )


def cosine_of_incidence(
    model: CalibrationModel, batch: FrameBatch, ray_directions: Float[Tensor, "H W 3"]
) -> Float[Tensor, "B H W"]:
    """Return the cosine between ray and plane normal, shape (B, H, W); negative in front of it."""
    with torch.no_grad():
        normal = batch.normal_tool @ model.hand_eye()[:3, :3]
    return (ray_directions @ normal.T).permute(2, 0, 1)
