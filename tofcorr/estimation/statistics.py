"""Quantiles and tails, robust weights against gross outliers, and images that are outliers."""

from typing import Literal, NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from tofcorr.spread import sigma_from_mad

RobustLoss = Literal["none", "huber", "cauchy"]

# Tuning constants, in standard deviations: 95 % efficiency on normal noise (Holland and Welsch
# 1977).
_HUBER = 1.345
_CAUCHY = 2.385


def student_quantile(probability: float, degrees_of_freedom: float | int) -> float:
    """Return the value that t stays below with a probability; NaN without a degree of freedom.

    Example:
        >>> round(student_quantile(0.975, 10), 4)
        2.2281
    """
    from scipy.special import stdtrit

    return float(stdtrit(degrees_of_freedom, probability))


def student_tail(value: float, degrees_of_freedom: float | int) -> float:
    """Return the probability of t above a value; NaN without a degree of freedom.

    Example:
        >>> round(student_tail(2.2281, 10), 4)
        0.025
    """
    from scipy.special import stdtr

    return float(stdtr(degrees_of_freedom, -value))


def f_tail(ratio: float, above: float | int, below: float | int) -> float:
    """Return the probability that F, a ratio of two mean squares, exceeds a value.

    Args:
        ratio: The value.
        above: Degrees of freedom of the mean square above.
        below: Of the one below.

    Example:
        >>> round(f_tail(3.7083, 3, 10), 4)
        0.05
    """
    from scipy.special import fdtrc

    return float(fdtrc(above, below, ratio))


def robust_weights(standardised: Float[Tensor, "*S"], loss: RobustLoss) -> Float[Tensor, "*S"]:
    """Return psi(u) / u of residuals in units of their scale, shape of `standardised`.

    Huber weighs with min(1, 1.345 / |u|): an outlier keeps a bounded pull. Cauchy weighs with
    1 / (1 + (u / 2.385)^2): the pull of a gross one vanishes.
    """
    size = standardised.abs()
    if loss == "huber":
        return (_HUBER / size.clamp(min=_HUBER)).to(standardised)
    if loss == "cauchy":
        return 1 / (1 + (size / _CAUCHY).square())
    return torch.ones_like(standardised)


def robust_scale(residuals: Float[Tensor, "S"]) -> float:
    """Return the standard deviation of residuals (S,) from their median absolute value."""
    return sigma_from_mad(float(residuals.abs().median()))


class ImageOutlier(NamedTuple):
    """An image whose error is much larger than that of the others.

    Attributes:
        frame: Its global number.
        rms_mm: Its error.
        z: How many robust standard deviations the logarithm of its error is above the median.
    """

    frame: int
    rms_mm: float
    z: float


def outlying_images(
    frames: np.ndarray, rms: np.ndarray, threshold: float = 3.5
) -> list[ImageOutlier]:
    """Return the images whose error is much larger than that of the others, the largest first.

    Args:
        frames: Global numbers, shape (N,).
        rms: Their root mean square errors, shape (N,), metres.
        threshold: Of the robust z score; Iglewicz and Hoaglin (1993) advise 3.5.
    """
    usable = np.isfinite(rms) & (rms > 0)
    logarithm = np.log(rms[usable])
    if len(logarithm) < 3:
        return []
    deviation = logarithm - np.median(logarithm)
    spread = sigma_from_mad(float(np.median(np.abs(deviation))))
    if not spread > 0:
        return []
    found = [
        ImageOutlier(int(frame), float(1e3 * error), float(z))
        for frame, error, z in zip(frames[usable], rms[usable], deviation / spread, strict=True)
        if z > threshold
    ]
    return sorted(found, key=lambda outlier: -outlier.z)
