"""The offset and two tilts of each pose that a residual contains."""

import torch
from torch import Tensor

from tofcorr.diagnosis.sums.study import Study


def pose_equations(study: Study, residual: Tensor) -> tuple[Tensor, Tensor]:
    """Return the normal equations of each pose's offset and tilts, (U, 3, 3) and (U, 3)."""
    unit, pose = study.unit_of_pixel, study.system.pose
    weighted = pose * study.weight[:, None]
    units = study.system.blocks.num_units
    inner = torch.zeros(units, 3, 3, dtype=torch.float64)
    inner = inner.index_add(0, unit, weighted[:, :, None] * pose[:, None, :])
    score = torch.zeros(units, 3, dtype=torch.float64)
    return inner, score.index_add(0, unit, weighted * residual[:, None])


def pose_surface(study: Study, own: Tensor) -> Tensor:
    """Return what offsets and tilts (U, 3) add to each pixel's distance, shape (M,), metres."""
    return (study.system.pose * own[study.unit_of_pixel]).sum(1)
