"""The loss of a calibration, for training loops of one's own."""

import torch
from torch import Tensor

from tofcorr.correction.hand_eye import HandEye
from tofcorr.correction.model import distance_to_plane
from tofcorr.data.frames import FrameBatch
from tofcorr.error_terms.model import ErrorModel
from tofcorr.module.correcting import required_amplitude


def point_to_plane_loss(
    batch: FrameBatch,
    error: ErrorModel,
    hand_eye: HandEye,
    ray_directions: Tensor,
    mean_conditions: Tensor,
) -> Tensor:
    """Return the mean squared distance of corrected points to their planes, square metres.

    Args:
        batch: Frames with the planes that they show; only `valid` pixels count.
        error: The error model.
        hand_eye: The hand-eye transform.
        ray_directions: Unit rays, shape (H, W, 3).
        mean_conditions: What unknown conditions are taken as, shape (C,).

    Raises:
        FrameError: The model needs amplitudes and the batch has none.
    """
    like = error.constant
    usable = batch.valid.to(like.device)
    # What is not measured may be NaN, which a factor of zero would not remove from the gradient.
    distance = torch.where(usable, batch.radial_distance.to(like), 1.0)
    strength = distance
    if error.needs_amplitude():
        strength = torch.where(usable, required_amplitude(batch.amplitude).to(like), 1.0)
    conditions = None
    if batch.conditions is not None and len(error.condition_terms):
        conditions = batch.conditions.to(like)
        conditions = torch.where(torch.isnan(conditions), mean_conditions, conditions)
    residual = distance_to_plane(
        distance - error(distance, strength, conditions),
        ray_directions,
        batch.normal_tool.to(like),
        batch.offset_tool.to(like),
        hand_eye(),
    )
    return torch.where(usable, residual, 0.0).square().sum() / usable.sum().clamp(min=1)
