"""How much a pixel scatters, and how much its residual may be trusted."""

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from tofcorr.diagnosis.sums.observations import Observations
from tofcorr.diagnosis.sums.prediction import predicted_images

# Frames with one pose and target are repeats from this number on.
_LEAST_REPEATS = 3
_BINS = 24
_LEAST_IN_BIN = 200
# Differences are taken over so many pixels: cameras filter their images, and nearest neighbours
# then share much of their noise.
_SPACING = 3
# The second difference x - (left + right) / 2 of independent noise has 1.5 times its variance.
_SECOND_DIFFERENCE = 1.5
_MAD_TO_SIGMA = 1.4826
# Residuals beyond so many scales are bounded, and beyond the second number left out.
_BOUND, _LEAVE_OUT = 4.0, 8.0
_LEAST_SIGMA = 1e-5
# Pixels noisier than this, metres, count less in a gap stated in millimetres.
_CLEAR_SIGMA = 0.005
# Pixels whose residuals are compared with one another, and the largest error they can share, m.
_PER_GROUP = 32.0
_MOST_SHARED = 0.1
# Noise is extrapolated to this factor (natural logarithm) beyond the darkest knot.
_MOST_DARKER = 3.0
# So much of the variance is noise at least, whatever the fixed pattern.
_LEAST_RANDOM = 0.05


class _Differences(NamedTuple):
    """Second differences, the brightness in their middle, their frame and place in the image."""

    difference: np.ndarray
    brightness: np.ndarray
    frame: np.ndarray
    place: np.ndarray


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
        curve = np.interp(at, self.knots, np.log(self.sigma))
        darker = np.clip(self.knots[0] - at, 0.0, _MOST_DARKER)
        return np.exp(curve + self._slope() * darker) * self.factor[frame]

    def _slope(self) -> float:
        """Return how fast noise grows beyond the darkest knot; shot noise has a half."""
        if len(self.knots) < 4:
            return 0.0
        rise = np.log(self.sigma[0] / self.sigma[3]) / max(self.knots[3] - self.knots[0], 1e-9)
        return float(np.clip(rise, 0.0, 0.5))


def brightness_of(observations: Observations) -> Tensor:
    """Return what the noise depends on: amplitude, or 1 / distance^2 without it, shape (M,)."""
    if observations.amplitude is not None:
        return observations.amplitude
    return 1.0 / observations.measured.clamp(min=1e-3) ** 2


def estimate_noise(observations: Observations, tool_from_camera: Tensor) -> NoiseModel:
    """Estimate the noise from differences between neighbours, and its floor from repeats if any."""
    differences = _second_differences(observations, tool_from_camera)
    spread = _fitted(differences, observations.num_frames)
    typical = spread.of(brightness_of(observations), observations.frame)
    fixed = _fixed_square(differences, spread)
    random = np.maximum(spread.sigma**2 - fixed, _LEAST_RANDOM * spread.sigma**2)
    spread = replace(spread, sigma=np.maximum(np.sqrt(random), _LEAST_SIGMA))
    repeats, ratio = _from_repeats(observations, spread)
    floor = float((typical**2).mean().sqrt()) * ratio
    sigma = np.maximum(spread.sigma * ratio, _LEAST_SIGMA)
    return replace(spread, sigma=sigma, floor=floor, repeats=repeats)


def clarity(sigma: Tensor) -> Tensor:
    """Return how much pixels of this noise (M,) count in a gap stated in millimetres, 0 to 1."""
    return 1 / (1 + (sigma / _CLEAR_SIGMA) ** 2)


def shared_part(observations: Observations, residual: Tensor) -> Tensor:
    """Return what each pixel's residual has in common with pixels around it, shape (M,), metres.

    The median over pixels of about the same place in one image and on the same side of that place's
    brightness, bounded. A gross error of a single pixel has no part in it; saturation of a bright
    square, however large, has.
    """
    camera = observations.recording.camera
    pixel, frame = observations.pixel, observations.frame
    seen = float(observations.on_target.double().sum())
    density = len(pixel) / max(seen, 1.0)
    side = max(2, round((_PER_GROUP / min(density, 1.0)) ** 0.5))
    across = camera.width // side + 1
    tile = pixel // camera.width // side * across + pixel % camera.width // side
    group = frame * (across * (camera.height // side + 1)) + tile
    middle = _group_median(group, brightness_of(observations))
    group = 2 * group + (brightness_of(observations) > middle).long()
    return _group_median(group, residual).clamp(-_MOST_SHARED, _MOST_SHARED)


def _group_median(group: Tensor, values: Tensor) -> Tensor:
    """Return the (lower) median of each value's group, shape (M,)."""
    order = torch.from_numpy(np.lexsort((values.numpy(), group.numpy())))
    _, where, count = torch.unique(group, return_inverse=True, return_counts=True)
    first = count.cumsum(0) - count
    return values[order][first + (count - 1) // 2][where]


def robust_weights(residual: Tensor, sigma: Tensor, shared: Tensor | None = None) -> Tensor:
    """Return 1 for ordinary residuals, less for large ones and 0 for gross ones, shape (M,).

    The scale holds the noise and the common size of what is not yet explained, so that an effect
    of ordinary size keeps its weight; so does, however large, what a pixel shares with others.
    """
    residual = residual if shared is None else residual - shared
    ratio = residual / sigma
    common = _MAD_TO_SIGMA * float((ratio - ratio.median()).abs().median())
    scale = sigma * max(common, 1.0)
    size = (residual - residual.median()).abs() / scale
    return torch.where(size > _LEAVE_OUT, 0.0, (_BOUND / size.clamp(min=1e-12)).clamp(max=1.0))


def _second_differences(observations: Observations, tool_from_camera: Tensor) -> "_Differences":
    """Return second differences of the residual along rows."""
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
        middle = _inner(residual) - (_left(residual) + _right(residual)) / 2
        inside = _inner(use) & _left(use) & _right(use) & middle.isfinite()
        if observations.amplitude_images is not None:
            amplitude = observations.amplitude_images[part][:, skip].double()
            here = _inner(amplitude)
            around = (_right(amplitude) + _left(amplitude)) / 2
            # Neighbours of another brightness have other errors: their difference is no noise.
            apart = (_right(amplitude) - _left(amplitude)).abs()
            inside &= (apart < 0.25 * around) & ((here - around).abs() < 0.25 * around)
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


def _fitted(differences: _Differences, num_frames: int) -> NoiseModel:
    """Fit curve and factors in turn."""
    difference, brightness, frame, _ = differences
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


def _fixed_square(differences: _Differences, model: NoiseModel) -> float:
    """Return the variance of the differences that is the same in all frames, per pixel, m^2.

    It is a fixed pattern and no noise; products of different frames at one place estimate it.
    """
    expected = model._of(differences.brightness, differences.frame)
    weight = expected**-2
    weighted = expected * _clipped(differences.difference / expected) * weight
    total = np.bincount(differences.place, weighted)
    squares = np.bincount(differences.place, weighted**2)
    pairs = np.bincount(differences.place, weight) ** 2
    pairs = float((pairs - np.bincount(differences.place, weight**2)).sum())
    if len(differences.place) < _LEAST_IN_BIN or pairs <= 0:
        return 0.0
    return max(float((total**2 - squares).sum()) / pairs / _SECOND_DIFFERENCE, 0.0)


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
    """Bound values at six robust standard deviations.

    Where most values are equal, as coarsely rounded depth is, at six ordinary ones.
    """
    if not len(values):
        return values
    scale = _MAD_TO_SIGMA * np.median(np.abs(values)) or np.sqrt(np.mean(values**2))
    return np.clip(values, -6 * scale, 6 * scale)


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
        typical = 6 * _MAD_TO_SIGMA * float((around.abs() / expected).median())
        size = max(typical, 1.0) * expected
        share = clarity(expected)
        squares += float((share * torch.minimum(around.abs(), size) ** 2).sum()) / freedom
        model += float((share * expected**2).sum()) * len(members)
        count += len(members)
    return count, float(np.sqrt(squares / model)) if count else 1.0
