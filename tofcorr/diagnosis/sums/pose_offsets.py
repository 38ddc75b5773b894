"""The offset and two tilts of each pose that a residual contains."""

import torch
from torch import Tensor

from tofcorr.diagnosis.sums.study import Study
from tofcorr.simulation.effects.derivative import by_frame


def pose_equations(study: Study, residual: Tensor) -> tuple[Tensor, Tensor]:
    """Return the normal equations of each pose's offset and tilts, (U, 3, 3) and (U, 3)."""
    pose = study.system.pose
    weighted = pose * study.weight[:, None]
    sums = study.observations.products(weighted, torch.cat([pose, residual[:, None]], dim=1))
    return sums[..., :-1], sums[..., -1]


def pose_surface(study: Study, own: Tensor) -> Tensor:
    """Return what offsets and tilts (U, 3) add to each pixel's distance, shape (M,), metres."""
    of_frame = own[study.observations.unit][:, :, None]
    return by_frame(study.system.pose, of_frame, study.observations.frame)[:, 0]
