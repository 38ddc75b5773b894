"""From where walls are seen, and whether a view is unlike those of the calibration.

Errors of neighbouring views are alike. Where no calibrated view is near, nothing has shown them.
"""

import math

import torch
from torch import Tensor

from tofcorr.fit.reference.linear_image import LinearImage

VIEW = 7
"""Numbers that describe a view: the wall's normal, direction to its middle, log of its distance."""

# Share of the calibrated views that have no other as near as this. Chosen: of views drawn at random
# from those of a calibration, one in twenty is then said to be unlike them.
_ALONE = 0.05
# Fewest calibrated views whose distances from each other say something. Chosen.
_FEWEST = 10


def view_of(image: LinearImage) -> Tensor:
    """Return what describes the view of an image, shape (7,)."""
    middle = image.points.mean(dim=0)
    distance = middle.norm()
    return torch.cat([image.normal, middle / distance, distance.log()[None]])


def share_unlike(views: Tensor, calibrated: Tensor) -> float:
    """Return the share of views further from any calibrated one than these are from each other.

    Args:
        views: Shape (N, 7).
        calibrated: Of one image of each pose, shape (K, 7); with few, no view counts as unlike.
    """
    if len(calibrated) < _FEWEST:
        return 0.0
    apart = torch.cdist(calibrated, calibrated)
    apart.fill_diagonal_(math.inf)
    usual = torch.quantile(apart.min(dim=1).values, 1 - _ALONE)
    return float((torch.cdist(views, calibrated).min(dim=1).values > usual).double().mean())
