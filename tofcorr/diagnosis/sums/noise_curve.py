r"""The noise as a function of brightness, held to the physics where few pixels say it.

With amplitude A, shot noise, read noise or background light, and rounding or jitter give the depth
the variance

.. math:: s^2(A) = \frac{a}{A} + \frac{b}{A^2} + c , \qquad a, b, c \ge 0 .

This law is fitted to the variances measured at some brightnesses. Each of these is then averaged
with the law's, so that many differences give a curve of any form, and few give the law. Beyond the
darkest and the brightest one the law goes on.
"""

from dataclasses import replace

import numpy as np
from torch import Tensor

from tofcorr.diagnosis.sums.pixel_noise import PixelNoise
from tofcorr.diagnosis.sums.robust_weights import no_gross_error
from tofcorr.estimation.nonnegative import nonnegative_least_squares

# What the law counts beside the differences at one brightness, as a number of differences. Chosen:
# 200 determine a standard deviation to 5 %, about as well as the law describes a camera.
_LAW_COUNT = 200.0
# Weight of the prior that noise is shot noise, a / A, as a number of differences. Chosen, small.
_SHOT_COUNT = 20.0
# Solutions of the law: the weights of each come from the one before.
_ROUNDS = 3
# The law is used over this range of log brightness beyond the measured ones, a factor of e^3 = 20.
# Beyond it stays constant, so that pixels without signal get no absurd value.
_BEYOND = 3.0
# Fewest pixels of like brightness whose residuals say their noise. Chosen: 50 determine a standard
# deviation to 10 %.
_LEAST = 50
# Most groups of such pixels on either side of the measured ones. Chosen; the law is smooth.
_MOST = 8
# Least ratio of squares. Chosen: residuals may be equal where depth is rounded.
_LEAST_RATIO = 1e-3
# What counts as well known, as a number of differences. Chosen, far above what the law counts.
_KNOWN_COUNT = 1e5
# Points in that range. Chosen; the logarithm of the noise bends little between them.
_POINTS = 6


def noise_curve(
    brightness: np.ndarray, variance: np.ndarray, count: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return knots of log brightness and standard deviations there, both (B + 12,).

    Args:
        brightness: Where the noise was measured, ascending, positive, shape (B,).
        variance: Measured, positive, shape (B,), m^2.
        count: Number of squares behind each, shape (B,).
    """
    at = np.log(brightness)
    middle = at[len(at) // 2]
    law = _fitted(_columns(at - middle), variance, count)
    mixed = (count * variance + _LAW_COUNT * (_columns(at - middle) @ law)) / (count + _LAW_COUNT)
    away = _BEYOND * np.arange(1, _POINTS + 1) / _POINTS
    darker, brighter = at[0] - away[::-1], at[-1] + away
    # The law goes on from what the mixture says at the ends.
    first, last = mixed[[0, -1]] / (_columns(at[[0, -1]] - middle) @ law)
    variances = [
        first * (_columns(darker - middle) @ law),
        mixed,
        last * (_columns(brighter - middle) @ law),
    ]
    return np.concatenate([darker, at, brighter]), np.sqrt(np.concatenate(variances))


def with_residuals(
    noise: PixelNoise, brightness: Tensor, frame: Tensor, deviation: Tensor
) -> PixelNoise:
    """Return the noise that pixels show which are darker or brighter than all compared neighbours.

    Args:
        noise: Estimated from neighbours of like brightness.
        brightness: Of each pixel, shape (M,).
        frame: Frame of each pixel, shape (M,).
        deviation: Of its residual from those of its neighbours, shape (M,), metres.
    """
    at = np.log(np.maximum(brightness.numpy(), 1e-12))
    ratios = (deviation / noise.at(brightness, frame)).numpy()
    known = slice(_POINTS, len(noise.knots) - _POINTS)
    middles, variances = [noise.knots[known]], [noise.sigma[known] ** 2]
    darker, brighter = at < noise.knots[known][0], at > noise.knots[known][-1]
    # Brighter pixels have no more noise than the law says: what is more there, saturation makes.
    for outside, most in ((darker, np.inf), (brighter, 1.0)):
        chosen = np.flatnonzero(outside)
        if len(chosen) < _LEAST:
            continue
        groups = np.array_split(chosen[np.argsort(at[chosen])], min(len(chosen) // _LEAST, _MOST))
        for members in groups:
            ratio = ratios[members]
            ratio = ratio[no_gross_error(ratio)]
            middle = float(np.median(at[members]))
            own = np.exp(np.interp(middle, noise.knots, np.log(noise.sigma)))
            middles.append(np.array([middle]))
            square = float(np.mean(ratio**2))
            variances.append(np.array([np.clip(square, _LEAST_RATIO, most) * own**2]))
    middle, variance = np.concatenate(middles), np.concatenate(variances)
    order = np.argsort(middle)
    count = np.full(len(middle), _KNOWN_COUNT)
    knots, sigma = noise_curve(np.exp(middle[order]), variance[order], count)
    return replace(noise, knots=knots, sigma=sigma)


def _columns(log_brightness: np.ndarray) -> np.ndarray:
    """Return 1 / A, 1 / A^2 and 1, shape (B, 3)."""
    dark = np.exp(-log_brightness)
    return np.stack([dark, dark**2, np.ones_like(dark)], axis=1)


def _fitted(columns: np.ndarray, variance: np.ndarray, count: np.ndarray) -> np.ndarray:
    """Fit the law, weighted by the error of each variance, 2 / count of its square."""
    expected, law = variance, np.zeros(3)
    for _ in range(_ROUNDS):
        weight = np.sqrt(count) / expected
        level = float(np.average(variance / columns[:, 0], weights=count))
        prior = np.sqrt(_SHOT_COUNT) / max(level, 1e-30) * np.eye(3)[1:]
        left = np.concatenate([columns * weight[:, None], prior])
        right = np.concatenate([variance * weight, np.zeros(2)])
        law = nonnegative_least_squares(left, right)
        expected = np.maximum(columns @ law, 1e-3 * variance)
    return law
