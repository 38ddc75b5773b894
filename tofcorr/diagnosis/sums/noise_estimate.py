"""Estimates the pixel noise from differences between neighbours, and its level from repeats."""

from dataclasses import replace
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from tofcorr.diagnosis.sums.observations import Observations
from tofcorr.diagnosis.sums.pixel_noise import PixelNoise, brightness_of, gap_weight
from tofcorr.diagnosis.sums.prediction import predicted_images
from tofcorr.diagnosis.sums.repeats import same_exposure
from tofcorr.diagnosis.sums.robust_weights import MAD_TO_SIGMA

# Frames of one pose, target and exposure count as repeats from this number on. Two give one degree
# of freedom in each of thousands of pixels.
_LEAST_REPEATS = 2
# At most so many knots of the noise curve, and at least so many differences for each: a standard
# deviation is then known to 5 %.
_MOST_KNOTS = 24
_LEAST_PER_KNOT = 200
# Differences are taken over this many pixels. Cameras filter their images, so that nearest
# neighbours share much of their noise.
_SPACING = 3
# Variance of x - (left + right) / 2 for independent noise of variance one: 1 + 1/4 + 1/4.
_SECOND_DIFFERENCE = 1.5
# Noise is never assumed below this, metres, so that weights stay finite without noise.
_LEAST_SIGMA = 1e-5
# Minimum share of the variance of the differences that is treated as noise, whatever share the
# fixed pattern seems to explain. Chosen.
_LEAST_NOISE_SHARE = 0.05
# Neighbours whose amplitudes differ by more than this share are not compared: they have different
# errors. Chosen.
_SAME_BRIGHTNESS = 0.25
# Weight of the prior factor 1 of a frame, as a number of differences. Chosen.
_FRAME_PRIOR_COUNT = 20
# Values beyond this many robust standard deviations are clipped. Chosen.
_CLIP = 6
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
    typical = noise.at(brightness_of(observations), observations.frame)
    fixed = _fixed_square(differences, noise)
    random = np.maximum(noise.sigma**2 - fixed, _LEAST_NOISE_SHARE * noise.sigma**2)
    noise = replace(noise, sigma=np.maximum(np.sqrt(random), _LEAST_SIGMA))
    repeats, ratio = _from_repeats(observations, noise)
    floor = float((typical**2).mean().sqrt()) * ratio
    sigma = np.maximum(noise.sigma * ratio, _LEAST_SIGMA)
    return replace(noise, sigma=sigma, floor=floor, repeats=repeats)


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
            inside &= (apart < _SAME_BRIGHTNESS * around) & (
                (here - around).abs() < _SAME_BRIGHTNESS * around
            )
        else:
            here = 1.0 / _inner(predicted).clamp(min=1e-3) ** 2
        frame, row, column = torch.nonzero(inside).unbind(1)
        place = row * inside.shape[2] + column
        parts.append((middle[inside], here[inside], frame + start, place))
    columns = (torch.cat(part).numpy() for part in zip(*parts, strict=True))
    return _Differences(*columns)


def _inner(images: Tensor) -> Tensor:
    return images[:, :, _SPACING:-_SPACING]


def _left(images: Tensor) -> Tensor:
    return images[:, :, : -2 * _SPACING]


def _right(images: Tensor) -> Tensor:
    return images[:, :, 2 * _SPACING :]


def _fitted(differences: _Differences, num_frames: int) -> PixelNoise:
    """Fit the curve and the frames' factors in turn, three times."""
    difference, brightness, frame, _ = differences
    noise = PixelNoise(
        knots=np.zeros(1), sigma=np.ones(1), factor=np.ones(num_frames), floor=0.0, repeats=0
    )
    if len(difference) < _LEAST_PER_KNOT:
        scale = float(np.sqrt(np.mean(difference**2))) if len(difference) else 5e-3
        sigma = np.array([max(scale / np.sqrt(_SECOND_DIFFERENCE), _LEAST_SIGMA)])
        return replace(noise, sigma=sigma)
    order = np.argsort(brightness, kind="stable")
    ends = np.searchsorted(frame, np.arange(1, num_frames))
    for _ in range(3):
        knots, sigma = _by_brightness(difference / noise.factor[frame], brightness, order)
        noise = replace(noise, knots=knots, sigma=sigma)
        factor = np.ones(num_frames)
        expected = noise.at_numpy(brightness, frame) / noise.factor[frame]
        ratio = difference / (expected * np.sqrt(_SECOND_DIFFERENCE))
        for number, own in enumerate(np.split(ratio, ends)):
            total = np.sum(_clipped(own) ** 2) + _FRAME_PRIOR_COUNT
            factor[number] = np.sqrt(total / (len(own) + _FRAME_PRIOR_COUNT))
        noise = replace(noise, factor=factor / np.sqrt(np.mean(factor**2)))
    return noise


def _fixed_square(differences: _Differences, noise: PixelNoise) -> float:
    """Return the variance of the differences that is the same in all frames, per pixel, m^2.

    It belongs to a fixed pattern, not to the noise. The products of different frames at one place
    estimate it.
    """
    expected = noise.at_numpy(differences.brightness, differences.frame)
    weight = expected**-2
    weighted = expected * _clipped(differences.difference / expected) * weight
    total = np.bincount(differences.place, weighted)
    squares = np.bincount(differences.place, weighted**2)
    pairs = np.bincount(differences.place, weight) ** 2
    pairs = float((pairs - np.bincount(differences.place, weight**2)).sum())
    if len(differences.place) < _LEAST_PER_KNOT or pairs <= 0:
        return 0.0
    return max(float((total**2 - squares).sum()) / pairs / _SECOND_DIFFERENCE, 0.0)


def _by_brightness(
    difference: np.ndarray, brightness: np.ndarray, order: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return knots and standard deviations of groups of equal size, in the order of brightness."""
    count = int(np.clip(len(order) // _LEAST_PER_KNOT, 1, _MOST_KNOTS))
    knots, sigma = [], []
    for members in np.array_split(order, count):
        values = difference[members]
        spread = np.sqrt(np.mean(_clipped(values - np.median(values)) ** 2) / _SECOND_DIFFERENCE)
        knots.append(np.log(max(float(np.median(brightness[members])), 1e-12)))
        sigma.append(max(float(spread), _LEAST_SIGMA))
    return np.array(knots), np.array(sigma)


def _clipped(values: np.ndarray) -> np.ndarray:
    """Clip values at six robust standard deviations.

    The ordinary standard deviation replaces the robust one where most values are equal, as in
    coarsely rounded depth.
    """
    if not len(values):
        return values
    scale = MAD_TO_SIGMA * np.median(np.abs(values)) or np.sqrt(np.mean(values**2))
    return np.clip(values, -_CLIP * scale, _CLIP * scale)


def _from_repeats(observations: Observations, noise: PixelNoise) -> tuple[int, float]:
    """Compare the variation over repeated frames with the noise model.

    Returns:
        The number of repeated frames, and the root of measured over modelled mean square; 0 and 1
        without repeats.
    """
    squares, model, count = 0.0, 0.0, 0
    for members in same_exposure(observations):
        if len(members) < _LEAST_REPEATS:
            continue
        images = observations.distance_images[members].double()
        use = (images > 0).all(0) & observations.on_target[members].all(0)
        if not use.any():
            continue
        values = images[:, use]
        values = values - values.mean(1, keepdim=True)
        around = values - values.mean(0)
        freedom = (len(members) - 1) / len(members)
        brightness = 1.0 / images[:, use].mean(0) ** 2
        if observations.amplitude_images is not None:
            brightness = observations.amplitude_images[members].double()[:, use].mean(0)
        at = torch.full(brightness.shape, int(members[0]))
        expected = noise.at(brightness, at)
        typical = _CLIP * MAD_TO_SIGMA * float((around.abs() / expected).median())
        size = max(typical, 1.0) * expected
        weight = gap_weight(expected)
        squares += float((weight * torch.minimum(around.abs(), size) ** 2).sum()) / freedom
        model += float((weight * expected**2).sum()) * len(members)
        count += len(members)
    return count, float(np.sqrt(squares / model)) if count else 1.0
