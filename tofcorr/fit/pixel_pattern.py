r"""Estimates the fixed pattern: one offset a pixel, shrunk towards zero.

The pattern has as many unknowns as the image has pixels, so it does not go through the moments.
With hand-eye and coefficients held, pixel v's best offset is the weighted mean of its residuals
along the ray, with the cosines c of incidence

.. math:: m_v = \frac{\sum_i c_{iv} r_{iv}}{\sum_i c_{iv}^2}

The prior N(0, tau^2) multiplies it by tau^2 / (tau^2 + s_v^2), with s_v the standard error of m_v.
One pass over the pixels gives all of them. The terms were fitted first, so what is smooth over the
image stays with them.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from tofcorr.correction.model import CalibrationModel
from tofcorr.pixels.dataset import Dataset
from tofcorr.pixels.plane_distance import cosine_of_incidence, distance_to_plane


class _Sums(NamedTuple):
    """Sums over the frames: c r, c^2, r^2 and the count, each (H, W)."""

    product: Tensor
    square: Tensor
    residual: Tensor
    number: Tensor


def fixed_pattern(
    dataset: Dataset,
    frames: Sequence[int] | np.ndarray,
    model: CalibrationModel,
    spread: float | None = None,
    device: str = "cpu",
) -> tuple[Tensor, float]:
    """Return the pixels' offsets (H, W) in metres, and their standard deviation.

    Args:
        dataset: The recordings.
        frames: Global numbers of the frames fitted.
        model: The fitted model; its own pattern must be zero.
        spread: Standard deviation tau of the offsets, metres; None: from the data, as the variance
            of the means beyond their own uncertainty (empirical Bayes).
        device: Where to compute.
    """
    sums = _sums(dataset, frames, model, device)
    seen = sums.square > 0
    mean = torch.where(seen, sums.product / sums.square.clamp(min=1e-300), 0.0)
    within = (sums.residual - mean * sums.product).clamp(min=0)
    freedom = (sums.number - 1).clamp(min=0)
    variance = within.sum() / freedom.sum().clamp(min=1)
    own = torch.where(seen, variance / sums.square.clamp(min=1e-300), torch.inf)
    if spread is None:
        excess = mean[seen].square().mean() - own[seen].mean() if bool(seen.any()) else mean.sum()
        spread = float(excess.clamp(min=0).sqrt())
    return mean * spread**2 / (spread**2 + own).clamp(min=1e-300), spread


def _sums(
    dataset: Dataset, frames: Sequence[int] | np.ndarray, model: CalibrationModel, device: str
) -> _Sums:
    rays = dataset.ray_directions()
    total = _Sums(*(rays.new_zeros(rays.shape[:2]) for _ in range(4)))
    rays = rays.to(device)
    for batch in dataset.batches(frames, device):
        found = distance_to_plane(model, batch, rays)
        cosine = cosine_of_incidence(model, batch, rays)
        valid = batch.valid.to(found)
        sums = (cosine * found * valid, cosine**2 * valid, found**2 * valid, valid)
        total = _Sums(*(a + b.sum(0).cpu() for a, b in zip(total, sums, strict=True)))
    return total
