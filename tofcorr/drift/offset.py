r"""By how much a camera reads too far, from corrected images of walls.

With residuals r, gains g and the wall's unknown place projected out of both,
:math:`\hat\delta = g \cdot r / g \cdot g`, so that a displaced or turned wall is not mistaken for
an offset. Little of g is left for a wall that is unknown in every image (only the curvature of a
shifted plane), and all of it for a known one.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from tofcorr.drift.corrected_images import CorrectedImage, Wall
from tofcorr.drift.projection import project_out


class Offset(NamedTuple):
    """The offset along the ray; positive where the camera reads too far.

    Attributes:
        value: Of all images, metres.
        standard_error: Of that value, metres.
        degrees_of_freedom: Of the standard error.
        of_image: Each image's own offset, shape (N,), metres.
    """

    value: float
    standard_error: float
    degrees_of_freedom: int
    of_image: np.ndarray


def estimate_offset(
    images: Sequence[CorrectedImage], wall: Wall, covariance: Tensor | None
) -> Offset:
    """Return the offset, with a standard error from the variation between the images.

    Args:
        images: At least one. With several, each is one observation; with one, its pixels are.
        wall: What is known of the wall.
        covariance: Of the model's coefficients, at least (K, K), square metres; None: unknown.
            Where the wall is unknown, an error of the calibrated shape looks like an offset, so
            this uncertainty is added.
    """
    groups = [images] if wall == "one" else [[image] for image in images]
    scores, weights, leverages = [], [], []
    for group in groups:
        residual = torch.cat([image.residual for image in group])
        gain = torch.cat([image.gain for image in group])
        basis = torch.cat([image.basis for image in group])
        if wall != "recorded":
            nuisance = torch.cat([image.nuisance for image in group])
            residual, gain, basis = project_out(nuisance, residual, gain, basis)
        start = 0
        for image in group:
            own = slice(start, start + len(image.gain))
            start = own.stop
            scores.append(float(gain[own] @ residual[own]))
            weights.append(float(gain[own] @ gain[own]))
            leverages.append(gain[own] @ basis[own])
    score, weight = np.array(scores), np.array(weights)
    offset = float(score.sum() / weight.sum())
    variance = _variance(score - offset * weight, float(weight.sum()), images)
    if wall != "recorded" and covariance is not None:
        leverage = torch.stack(leverages).sum(dim=0) / weight.sum()
        known = covariance[: len(leverage), : len(leverage)]
        variance += float(leverage @ known @ leverage)
    return Offset(offset, math.sqrt(variance), max(len(images) - 1, 1), score / weight)


def _variance(apart: np.ndarray, weight: float, images: Sequence[CorrectedImage]) -> float:
    """Return the variance of the offset, from the variation between images (or pixels of one)."""
    count = len(images)
    if count == 1:
        residual = images[0].residual
        return float((residual - residual.mean()).square().mean()) / weight
    return count / (count - 1) * float((apart**2).sum()) / weight**2
