r"""Tails of distributions, robust weights and scales, outlying images, and planes of points.

On the plane g . x = 1 the inverse distance is linear in the ray, :math:`1 / D = g \cdot a`, so that
each fit of a plane is a linear one. Its unit normal towards the camera is -g / |g|, the camera's
distance from it 1 / |g|.
"""

from typing import Any, Literal, TypeVar

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from tofcorr.options import STRAY

LEVEL = 0.05
"""What every interval leaves out, and the level of every test of a fit; the usual one."""
RobustLoss = Literal["none", "huber", "cauchy"]
SpreadT = TypeVar("SpreadT", float, np.floating, np.ndarray, Tensor)

# Tuning constants, in standard deviations: 95 % efficiency on normal noise (Holland and Welsch
# 1977).
_HUBER = 1.345
_CAUCHY = 2.385
# 1 / Phi^-1(3/4): half of a normal distribution lies within 0.6745 standard deviations.
_SIGMA_PER_MAD = 1.482602218505602


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


def sigma_from_mad(median_absolute_deviation: SpreadT) -> SpreadT:
    """Return the standard deviation of a normal distribution of this median absolute deviation.

    Gross outliers hardly change a median, so the result is that of the bulk of the values.

    Args:
        median_absolute_deviation: A number, an array or a tensor, in any unit.

    Returns:
        1.4826 times it, in the same unit.

    Example:
        >>> round(sigma_from_mad(2.0), 4)
        2.9652
    """
    return _SIGMA_PER_MAD * median_absolute_deviation


def without_strays(values: np.ndarray) -> tuple[float, float]:
    """Return the range of values without a thousandth at either end, which may be stray pixels."""
    low, high = np.quantile(values, (STRAY, 1 - STRAY)).tolist()
    return low, high


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


def outlying_images(frames: np.ndarray, rms: np.ndarray) -> list[dict[str, Any]]:
    """Return the images whose error is much larger than that of the others, the largest first.

    Args:
        frames: Global numbers, shape (N,).
        rms: Their root mean square errors, shape (N,), metres.

    Returns:
        Of each its global number, its error in millimetres, and how many robust standard deviations
        the logarithm of its error is above the median.
    """
    usable = np.isfinite(rms) & (rms > 0)
    frames, rms, logarithm = frames[usable], rms[usable], np.log(rms[usable])
    deviation = logarithm - np.median(logarithm) if len(logarithm) > 2 else np.zeros(1)
    spread = sigma_from_mad(float(np.median(np.abs(deviation))))
    z = deviation / (spread or np.inf)
    return [
        {"frame": int(frames[k]), "rms_mm": float(1e3 * rms[k]), "z": float(z[k])}
        for k in np.argsort(-z)
        if 2 * z[k] > 7  # Iglewicz and Hoaglin (1993) advise 3.5.
    ]


def deviation(
    rays: Float[Tensor, "V 3"], distance: Float[Tensor, "*#B V"], gradient: Float[Tensor, "*B 3"]
) -> Float[Tensor, "*B V"]:
    """Return measured less fitted distance along each ray; infinite where no ray meets the plane.

    Args:
        rays: Unit rays.
        distance: Along them, metres.
        gradient: g of the plane g . x = 1, 1 / m.
    """
    inverse = gradient @ rays.T
    return torch.where(inverse > 0, distance - 1 / inverse, torch.inf)


def fit_plane(
    rays: Float[Tensor, "V 3"],
    distance: Float[Tensor, "B V"],
    valid: Bool[Tensor, "B V"],
    start: Float[Tensor, "B 3"] | None = None,
    tolerance: float = torch.inf,
    steps: int = 15,
) -> Float[Tensor, "B 3"]:
    """Fit a plane to each of B images, reweighted with Cauchy's weights.

    Args:
        rays: Unit rays of V pixels.
        distance: Along them, metres; any number where not valid.
        valid: Which pixels may be used.
        start: Planes to start from; None: all valid pixels weigh the same at first.
        tolerance: Pixels farther from the latest plane are left out, metres.
        steps: How many times it is fitted; the weights have settled after fifteen.

    Returns:
        g of each plane g . x = 1.
    """
    inverse = 1 / torch.where(valid, distance, 1.0)
    # Powers of the distance make a least-squares fit of inverse distances one of distances.
    full = valid * inverse.pow(-4)
    weight = full if start is not None else valid.to(inverse)
    gradient = rays.new_zeros(len(distance), 3) if start is None else start
    for step in range(steps):
        if step or start is not None:
            # Deviations as distances, not as inverse distances: their noise is of one size.
            off = (inverse - gradient @ rays.T) / inverse.square()
            used = valid & (off.abs() <= tolerance)
            typical = torch.where(used, off.abs(), torch.nan).nanmedian(dim=1, keepdim=True).values
            # No recording tells distances more finely than float32.
            least = torch.finfo(torch.float32).eps
            scale = sigma_from_mad(typical.nan_to_num(0.0)).clamp(min=least)
            weight = torch.where(used, full * robust_weights(off / scale, "cauchy"), 0.0)
        matrix = torch.einsum("bv,va,vc->bac", weight, rays, rays)
        right = (weight * inverse) @ rays
        ridge = torch.finfo(inverse.dtype).eps * torch.eye(3).to(inverse)
        enough = (weight > 0).sum(dim=1) > 2
        found = torch.linalg.solve(matrix + ridge, right[:, :, None])[:, :, 0]
        gradient = torch.where(enough[:, None], found, gradient)
    return gradient


def largest_plane(
    rays: Float[Tensor, "V 3"],
    distance: Float[Tensor, "V"],
    tolerance: float,
    generator: torch.Generator,
    triples: Int[Tensor, "T 3"] | None = None,
) -> Float[Tensor, "3"] | None:
    """Return the plane that most of some pixels lie on (Fischler and Bolles 1981).

    Planes through three pixels are compared by their truncated squared deviations (Torr 2000); the
    best few are fitted to what is near them, and compared again.

    Args:
        rays: Unit rays.
        distance: Along them, metres.
        tolerance: Distance along the ray within which a pixel is on a plane, metres.
        generator: Draws pixels; the same state gives the same plane.
        triples: Places of the three pixels of each plane that is tried; None: 300 are drawn. With a
            third of the pixels on the largest plane, these all miss it with a probability of
            (1 - 1/27)^300 = 1e-5.

    Returns:
        g of the plane g . x = 1; None where no three pixels determine one.
    """
    if triples is None:
        number = 0 if len(distance) < 3 else 300
        triples = torch.randint(max(len(distance), 1), (number, 3), generator=generator)
    matrix = rays[triples]
    sound = torch.linalg.det(matrix).abs() > torch.finfo(torch.float32).eps
    if not bool(sound.any()):
        return None
    # As many pixels tell planes apart: the share of one on 5 % of them is then known to a tenth.
    judges = torch.randperm(len(distance), generator=generator)[:2000]

    def cost(tried: Float[Tensor, "T 3"]) -> Float[Tensor, "T"]:
        off = deviation(rays[judges], distance[None, judges], tried)
        return (off / tolerance).square().clamp(max=1.0).sum(dim=1)

    tried = torch.linalg.solve(matrix[sound], 1 / distance[triples[sound]][:, :, None])[:, :, 0]
    best = tried[cost(tried).argsort(stable=True)[:4]]
    every = torch.ones(len(best), len(distance), dtype=torch.bool, device=distance.device)
    fitted = fit_plane(rays, distance.expand(len(best), -1), every, best, tolerance, steps=4)
    return fitted[int(cost(fitted).argmin())]
