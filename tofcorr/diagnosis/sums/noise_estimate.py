"""Estimates the pixel noise from differences between neighbours, and its level from repeats."""

from dataclasses import replace
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from tofcorr.diagnosis.sums.noise_curve import noise_curve
from tofcorr.diagnosis.sums.observations import Observations
from tofcorr.diagnosis.sums.pixel_noise import PixelNoise
from tofcorr.diagnosis.sums.prediction import predicted_images
from tofcorr.diagnosis.sums.repeated_noise import repeated_noise
from tofcorr.diagnosis.sums.robust_weights import no_gross_error
from tofcorr.observables.neighbours import SAME_BRIGHTNESS, SECOND_DIFFERENCE, SPACING

# At most so many groups of pixels of like brightness, and at least so many differences in each: a
# standard deviation is then known to 10 %.
_MOST_KNOTS = 24
_LEAST_PER_KNOT = 50
# Noise where no two neighbours can be compared, metres. Chosen: that of a usual camera.
_UNKNOWN_SIGMA = 0.005
# Noise is never assumed below this, metres, so that weights stay finite without noise.
_LEAST_SIGMA = 1e-5
# Minimum share of the variance of the differences that is treated as noise, whatever share the
# fixed pattern seems to explain. Chosen.
_LEAST_NOISE_SHARE = 0.05
# Weight of the prior factor 1 of a frame, as a number of differences. Chosen.
_FRAME_PRIOR_COUNT = 20
# A fixed pattern counts from this many standard errors of its variance on. The usual convention.
_SIGNIFICANT = 2.0
# Largest relative error of the level, where hardly any two neighbours can be compared. Chosen.
_MOST_ERROR = 0.5
# Of larger recordings only every k-th row is read: about this many pixels in all, and at most so
# many at a time. Chosen to bound time and memory.
_MOST_PIXELS = 4_000_000
_CHUNK_PIXELS = 500_000


class _Differences(NamedTuple):
    """Second differences; brightness, frame and place in the image of their middle pixels."""

    difference: np.ndarray
    brightness: np.ndarray
    frame: np.ndarray
    place: np.ndarray


def estimate_noise(observations: Observations, tool_from_camera: Tensor) -> PixelNoise:
    """Estimate the pixel noise.

    Its dependence on brightness and frame comes from second differences along rows, less the
    fixed pattern. Its level comes from repeated frames where there are any.

    Args:
        observations: The pixels and images.
        tool_from_camera: Hand-eye transform, shape (4, 4); its prediction is subtracted first.
    """
    differences = _second_differences(observations, tool_from_camera)
    noise = _fitted(differences, observations.num_frames)
    fixed = _fixed_square(differences, noise)
    random = np.maximum(noise.sigma**2 - fixed, _LEAST_NOISE_SHARE * noise.sigma**2)
    noise = replace(noise, sigma=np.maximum(np.sqrt(random), _LEAST_SIGMA))
    found = repeated_noise(observations, noise)
    sigma = np.maximum(noise.sigma * found.finite_ratio, _LEAST_SIGMA)
    # Two standard errors; second differences that overlap count half.
    error = 2 / np.sqrt(max(len(differences.place), 1))
    return replace(noise, sigma=sigma, repeated=found, error=min(error, _MOST_ERROR))


def _second_differences(observations: Observations, tool_from_camera: Tensor) -> _Differences:
    """Return second differences of the residual along rows."""
    parts = []
    skip = slice(None, None, max(1, observations.on_target.numel() // _MOST_PIXELS))
    step = max(1, _CHUNK_PIXELS // observations.on_target[0].numel())
    for start in range(0, observations.num_frames, step):
        part = slice(start, start + step)
        measured = observations.distance_images[part][:, skip].double()
        use = observations.on_target[part][:, skip] & (measured > 0)
        predicted = predicted_images(observations, tool_from_camera, part, skip)
        residual = measured - predicted
        middle = _inner(residual) - (_left(residual) + _right(residual)) / 2
        inside = _inner(use) & _left(use) & _right(use) & middle.isfinite()
        if observations.amplitude_images is not None:
            amplitude = observations.amplitude_images[part][:, skip].double()
            here = _inner(amplitude)
            around = (_right(amplitude) + _left(amplitude)) / 2
            apart = (_right(amplitude) - _left(amplitude)).abs()
            inside &= (apart < SAME_BRIGHTNESS * around) & (
                (here - around).abs() < SAME_BRIGHTNESS * around
            )
        else:
            here = 1.0 / _inner(predicted).clamp(min=1e-3) ** 2
        frame, row, column = torch.nonzero(inside).unbind(1)
        place = row * inside.shape[2] + column
        parts.append((middle[inside], here[inside], frame + start, place))
    columns = (torch.cat(part).numpy() for part in zip(*parts, strict=True))
    return _Differences(*columns)


def _inner(images: Tensor) -> Tensor:
    return images[:, :, SPACING:-SPACING]


def _left(images: Tensor) -> Tensor:
    return images[:, :, : -2 * SPACING]


def _right(images: Tensor) -> Tensor:
    return images[:, :, 2 * SPACING :]


def _fitted(differences: _Differences, num_frames: int) -> PixelNoise:
    """Fit the curve and the frames' factors in turn, three times."""
    difference, brightness, frame, _ = differences
    noise = PixelNoise(knots=np.zeros(1), sigma=np.ones(1), factor=np.ones(num_frames))
    if len(difference) < _LEAST_PER_KNOT:
        scale = float(np.mean(difference**2)) if len(difference) else _UNKNOWN_SIGMA**2
        one = np.ones(1)
        middle = max(float(np.median(brightness)), 1e-12) if len(brightness) else 1.0
        variance = max(scale / SECOND_DIFFERENCE, _LEAST_SIGMA**2)
        knots, sigma = noise_curve(middle * one, variance * one, max(len(difference), 1) * one)
        return replace(noise, knots=knots, sigma=sigma)
    order = np.argsort(brightness, kind="stable")
    ends = np.searchsorted(frame, np.arange(1, num_frames))
    for _ in range(3):
        knots, sigma = _by_brightness(difference / noise.factor[frame], brightness, order)
        noise = replace(noise, knots=knots, sigma=sigma)
        factor = np.ones(num_frames)
        expected = noise.at_numpy(brightness, frame) / noise.factor[frame]
        ratio = difference / (expected * np.sqrt(SECOND_DIFFERENCE))
        for number, own in enumerate(np.split(ratio, ends)):
            kept = own[no_gross_error(own)]
            total = np.sum(kept**2) + _FRAME_PRIOR_COUNT
            factor[number] = np.sqrt(total / (len(kept) + _FRAME_PRIOR_COUNT))
        noise = replace(noise, factor=factor / np.sqrt(np.mean(factor**2)))
    return noise


def _fixed_square(differences: _Differences, noise: PixelNoise) -> float:
    """Return the variance of the differences that is the same in all frames, per pixel, m^2.

    It belongs to a fixed pattern, not to the noise. The products of different frames at one place
    estimate it.
    """
    difference, place = differences.difference, differences.place
    expected = noise.at_numpy(differences.brightness, differences.frame)
    weight = np.where(no_gross_error(difference / expected), expected**-2, 0.0)
    weighted = difference * weight
    total = np.bincount(place, weighted)
    squares = np.bincount(place, weighted**2)
    pairs = np.bincount(place, weight) ** 2
    pairs = float((pairs - np.bincount(place, weight**2)).sum())
    if len(place) < _LEAST_PER_KNOT or pairs <= 0:
        return 0.0
    products = float((total**2 - squares).sum())
    spread = squares**2 - np.bincount(place, weighted**4)
    if products < _SIGNIFICANT * float(np.sqrt(2 * spread.sum())):
        return 0.0
    return products / pairs / SECOND_DIFFERENCE


def _by_brightness(
    difference: np.ndarray, brightness: np.ndarray, order: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return knots and standard deviations from groups of equal size, in order of brightness."""
    count = int(np.clip(len(order) // _LEAST_PER_KNOT, 1, _MOST_KNOTS))
    groups = np.array_split(order, count)
    middles, variances = np.empty(count), np.empty(count)
    for number, members in enumerate(groups):
        values = difference[members]
        values = values - np.median(values)
        square = np.mean(values[no_gross_error(values)] ** 2) / SECOND_DIFFERENCE
        middles[number] = max(float(np.median(brightness[members])), 1e-12)
        variances[number] = max(float(square), _LEAST_SIGMA**2)
    return noise_curve(middles, variances, np.array([len(members) for members in groups]))
