"""Structure that poses share at one pixel, at one place of the target, or at one brightness.

The noise of two poses is independent. So the product of their mean residuals in one cell, over all
pairs of poses, estimates the square of the structure there, however neighbouring pixels share their
noise: a rough target looks like filtered noise in any one image, but all images of it agree.
"""

from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from tofcorr.diagnosis.sums.pixel_noise import brightness_of
from tofcorr.diagnosis.sums.study import Study

# Structure counts from this many standard errors on. The usual convention.
_SIGNIFICANT = 3.0
# Cells that fewer poses show are not used. Chosen: three give three pairs.
_LEAST_POSES = 3
# Groups of pixels of like brightness. Chosen: over a range of 1 to 30 in amplitude they differ by
# 9 %, far less than what errors of the amplitude need to change.
_BRIGHTNESSES = 40


class SharedByPoses(NamedTuple):
    """Structure that poses share.

    Attributes:
        square: Its mean square over the pixels, m^2; 0 where it is not significant.
        error: Standard error of `square`, by leaving out one pose at a time, m^2.
    """

    square: float
    error: float


NOTHING_SHARED = SharedByPoses(0.0, 0.0)
"""Where poses share nothing."""


def shared_by_poses(study: Study, residual: Tensor) -> SharedByPoses:
    """Return the largest of what poses share by pixel, place on the target, and brightness.

    Args:
        study: The recording.
        residual: Without each pose's offset and tilts, shape (M,), metres.
    """
    groups = study.observations.pixel, _places(study), _brightnesses(study)
    found = [_shared(study, residual, cells) for cells in groups]
    sure = [each for each in found if each.square > _SIGNIFICANT * each.error]
    return max(sure, key=lambda each: each.square, default=NOTHING_SHARED)


def _shared(study: Study, residual: Tensor, cells: Tensor) -> SharedByPoses:
    """Compare all pairs of poses cell by cell, shape (M,)."""
    units, size = study.system.blocks.num_units, int(cells.max()) + 1
    place, share = study.unit_of_pixel * size + cells, study.fit.share
    zeros = torch.zeros(units * size, dtype=torch.float64)
    own = zeros.index_add(0, place, share * residual).reshape(units, size)
    count = zeros.index_add(0, place, share).reshape(units, size)
    used = (count > 0).sum(0) >= _LEAST_POSES
    own, count = own[:, used], count[:, used]
    if not bool(used.any()):
        return NOTHING_SHARED
    # All poses at first, then all but one at a time.
    total, weight = (torch.cat([x.sum(0)[None], x.sum(0) - x]) for x in (own, count))
    squares, weights = (
        torch.cat([x.sum(0)[None], x.sum(0) - x]) for x in (own.square(), count.square())
    )
    pairs = (weight.square() - weights).clamp(min=torch.finfo(torch.float64).tiny)
    mean = ((total.square() - squares) / pairs * weight).sum(1) / weight.sum(1)
    spread = mean[1:] - mean[1:].mean()
    return SharedByPoses(
        float(mean[0]), float(((units - 1) / units * spread.square().sum()).sqrt())
    )


def _places(study: Study) -> Tensor:
    """Return the place on the target that each pixel sees, in cells of a typical footprint."""
    inputs, observations = study.inputs, study.observations
    footprint = float(inputs.radial_distance.median()) / inputs.camera.matrix[0][0]
    _, target = np.unique(np.asarray(observations.recording.frames.target), return_inverse=True)
    cells = torch.from_numpy(target)[observations.frame]
    places = torch.floor(inputs.target_xy / footprint).long()
    for along in (places - places.amin(0)).unbind(1):
        cells = cells * (along.max() + 1) + along
    return torch.unique(cells, return_inverse=True)[1]


def _brightnesses(study: Study) -> Tensor:
    """Return the group of like brightness of each pixel."""
    brightness = brightness_of(study.observations)
    order = torch.argsort(torch.argsort(brightness))
    return order * _BRIGHTNESSES // len(order)
