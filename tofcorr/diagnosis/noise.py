"""How much a pixel scatters, and how much its residual may be trusted."""

from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from tofcorr.diagnosis.observations import Observations
from tofcorr.diagnosis.prediction import predicted_images

# Frames with one pose and target are repeats from this number on.
_LEAST_REPEATS = 3
_BINS = 24
_LEAST_IN_BIN = 200
# The second difference x - (left + right) / 2 of independent noise has 1.5 times its variance.
_SECOND_DIFFERENCE = 1.5
_MAD_TO_SIGMA = 1.4826
# Residuals beyond so many scales are bounded, and beyond the second number left out.
_BOUND, _LEAVE_OUT = 4.0, 8.0
_LEAST_SIGMA = 1e-5


@dataclass(frozen=True, kw_only=True)
class NoiseModel:
    """Standard deviation of a pixel's noise: a curve over its amplitude, times one factor a frame.

    The factor takes up what differs from frame to frame, as background light does.

    Attributes:
        knots: Logarithms of amplitude (or of 1 / distance^2 without amplitudes), shape (B,).
        sigma: Shape (B,), metres.
        factor: Of every frame, shape (F,).
        floor: Root mean square noise of the chosen pixels, metres.
        repeats: Frames behind the floor that were taken without moving; 0: the floor comes from
            differences between neighbouring pixels, and is an upper bound.
    """

    knots: np.ndarray
    sigma: np.ndarray
    factor: np.ndarray
    floor: float
    repeats: int

    def of(self, brightness: Tensor, frame: Tensor) -> Tensor:
        """Return the standard deviation of pixels of this brightness and frame, (M,), metres."""
        return torch.from_numpy(self._of(brightness.numpy(), frame.numpy()))

    def _of(self, brightness: np.ndarray, frame: np.ndarray) -> np.ndarray:
        at = np.log(np.maximum(brightness, 1e-12))
        return np.interp(at, self.knots, self.sigma) * self.factor[frame]


def brightness_of(observations: Observations) -> Tensor:
    """Return what the noise depends on: amplitude, or 1 / distance^2 without it, shape (M,)."""
    if observations.amplitude is not None:
        return observations.amplitude
    return 1.0 / observations.measured.clamp(min=1e-3) ** 2


def estimate_noise(observations: Observations, tool_from_camera: Tensor) -> NoiseModel:
    """Estimate the noise from differences between neighbours, and its floor from repeats if any."""
    difference, brightness, frame = _second_differences(observations, tool_from_camera)
    spread = _fitted(difference, brightness, frame, observations.num_frames)
    typical = spread.of(brightness_of(observations), observations.frame)
    repeats, ratio = _from_repeats(observations, spread)
    floor = float((typical**2).mean().sqrt()) * ratio
    return replace(spread, sigma=spread.sigma * ratio, floor=floor, repeats=repeats)


def robust_weights(residual: Tensor, sigma: Tensor) -> Tensor:
    """Return 1 for ordinary residuals, less for large ones and 0 for gross ones, shape (M,).

    The scale holds the noise and the common size of what is not yet explained, so that an effect
    of ordinary size keeps its weight.
    """
    ratio = residual / sigma
    common = _MAD_TO_SIGMA * float((ratio - ratio.median()).abs().median())
    scale = sigma * max(common, 1.0)
    size = (residual - residual.median()).abs() / scale
    return torch.where(size > _LEAVE_OUT, 0.0, (_BOUND / size.clamp(min=1e-12)).clamp(max=1.0))


def _second_differences(
    observations: Observations, tool_from_camera: Tensor
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return second differences along rows of the residual, brightness in their middle, frame."""
    parts = []
    # Of large recordings some rows are enough.
    skip = slice(None, None, max(1, observations.on_target.numel() // 4_000_000))
    step = max(1, 500_000 // observations.on_target[0].numel())
    for start in range(0, observations.num_frames, step):
        part = slice(start, start + step)
        measured = observations.distance_images[part][:, skip].double()
        use = observations.on_target[part][:, skip] & (measured > 0)
        predicted = predicted_images(observations, tool_from_camera, part, skip)
        residual = measured - predicted
        middle = residual[:, :, 1:-1] - (residual[:, :, :-2] + residual[:, :, 2:]) / 2
        inside = use[:, :, 1:-1] & use[:, :, :-2] & use[:, :, 2:] & middle.isfinite()
        if observations.amplitude_images is not None:
            amplitude = observations.amplitude_images[part][:, skip].double()
            here = amplitude[:, :, 1:-1]
            around = (amplitude[:, :, 2:] + amplitude[:, :, :-2]) / 2
            # Neighbours of another brightness have other errors: their difference is no noise.
            apart = (amplitude[:, :, 2:] - amplitude[:, :, :-2]).abs()
            inside &= (apart < 0.25 * around) & ((here - around).abs() < 0.25 * around)
        else:
            here = 1.0 / predicted[:, :, 1:-1].clamp(min=1e-3) ** 2
        frame = torch.nonzero(inside)[:, 0] + start
        parts.append((middle[inside], here[inside], frame))
    difference, brightness, frame = (torch.cat(part).numpy() for part in zip(*parts, strict=True))
    return difference, brightness, frame


def _fitted(
    difference: np.ndarray, brightness: np.ndarray, frame: np.ndarray, num_frames: int
) -> NoiseModel:
    """Fit curve and factors in turn."""
    model = NoiseModel(
        knots=np.zeros(1), sigma=np.ones(1), factor=np.ones(num_frames), floor=0.0, repeats=0
    )
    if len(difference) < _LEAST_IN_BIN:
        scale = float(np.sqrt(np.mean(difference**2))) if len(difference) else 5e-3
        sigma = np.array([max(scale / np.sqrt(_SECOND_DIFFERENCE), _LEAST_SIGMA)])
        return replace(model, sigma=sigma)
    for _ in range(3):
        knots, sigma = _by_brightness(difference / model.factor[frame], brightness)
        model = replace(model, knots=knots, sigma=sigma)
        factor = np.ones(num_frames)
        expected = model._of(brightness, frame) / model.factor[frame]
        ratio = difference / (expected * np.sqrt(_SECOND_DIFFERENCE))
        for number in range(num_frames):
            own = ratio[frame == number]
            # A prior of twenty values keeps frames with few differences near one.
            factor[number] = np.sqrt((np.sum(_clipped(own) ** 2) + 20) / (len(own) + 20))
        model = replace(model, factor=factor / np.sqrt(np.mean(factor**2)))
    return model


def _by_brightness(difference: np.ndarray, brightness: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    order = np.argsort(brightness, kind="stable")
    count = int(np.clip(len(order) // _LEAST_IN_BIN, 1, _BINS))
    knots, sigma = [], []
    for members in np.array_split(order, count):
        values = difference[members]
        spread = np.sqrt(np.mean(_clipped(values - np.median(values)) ** 2) / _SECOND_DIFFERENCE)
        knots.append(np.log(max(float(np.median(brightness[members])), 1e-12)))
        sigma.append(max(float(spread), _LEAST_SIGMA))
    return np.array(knots), np.array(sigma)


def _clipped(values: np.ndarray) -> np.ndarray:
    """Bound values at six robust standard deviations."""
    if not len(values):
        return values
    limit = 6 * _MAD_TO_SIGMA * np.median(np.abs(values))
    return np.clip(values, -limit, limit)


def _from_repeats(observations: Observations, spread: NoiseModel) -> tuple[int, float]:
    """Compare the scatter over repeated frames with the noise model.

    Returns:
        The number of repeated frames, and scatter over model (root mean square); 0 and 1 without.
    """
    target = np.asarray(observations.recording.frames.target)
    unit = observations.unit.numpy()
    squares, model, count = 0.0, 0.0, 0
    for key in sorted(set(zip(unit.tolist(), target.tolist(), strict=True))):
        members = np.flatnonzero((unit == key[0]) & (target == key[1]))
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
        expected = spread.of(brightness, at)
        size = 6 * _MAD_TO_SIGMA * (around.abs() / expected).median() * expected
        squares += float((torch.minimum(around.abs(), size) ** 2).sum()) / freedom
        model += float((expected**2).sum()) * len(members)
        count += len(members)
    return count, float(np.sqrt(squares / model)) if count else 1.0
