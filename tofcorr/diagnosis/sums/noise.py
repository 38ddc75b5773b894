r"""The standard deviation of the noise of each pixel, as a function of its brightness.

Robust weights: gross errors of single pixels get less weight, structures keep theirs.

The noise as a function of brightness, held to the physics where few pixels say it.

With amplitude A, shot noise, read noise or background light, and rounding or jitter give the depth
the variance

.. math:: s^2(A) = \frac{a}{A} + \frac{b}{A^2} + c , \qquad a, b, c \ge 0 .

This law is fitted to the variances measured at some brightnesses. Each of these is then averaged
with the law's, so that many differences give a curve of any form, and few give the law. Beyond the
darkest and the brightest one the law goes on.

The noise in frames that were repeated, where a filter over time may make them alike.

Repeats differ by noise alone. A filter that keeps the share r of the frame before leaves noise of
variance s^2 with a correlation of r^k over k frames, so that frames k apart differ by

.. math:: \gamma_k = \tfrac12 E (x_t - x_{t+k})^2 = s^2 (1 - r^k), \qquad
          \gamma_2 / \gamma_1 = 1 + r .

Three frames of a pose give r, and with it s^2. Two do not.

Estimates the pixel noise from differences between neighbours, and its level from repeats.
"""

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from tofcorr.diagnosis.sums.observations import Observations, predicted_images, same_exposure
from tofcorr.observables.noise import frame_correlation, mean_correlation
from tofcorr.observables.read import SAME_BRIGHTNESS, SECOND_DIFFERENCE, SPACING, tiles_of

FLOOR_ERROR = 0.05
"""Relative uncertainty of the floor from repeats or neighbouring pixels. Chosen; a test compares
the noise estimate with the truth of a simulator to this accuracy."""
# Noise at which a pixel's weight in a mean square in millimetres has fallen to a half, metres.
# Chosen: the gaps of interest are a few millimetres, and noisier pixels cannot show them.
_HALF_WEIGHT_SIGMA = 0.005


class RepeatedNoise(NamedTuple):
    """What repeated frames say of the noise, each over what differences between neighbours say.

    Attributes:
        frames: Number of repeated frames; 0: they say nothing.
        least: Root mean square, with the weakest filter over time that they do not exclude; with
            none where no pose has three.
        ratio: With the filter that the frames show; infinite where no pose has three: any filter
            is possible.
        most: With the strongest filter that they do not exclude.
        error: Relative error of all three by how much poses differ, two standard errors; 0 of a
            single pose.
    """

    frames: int
    least: float
    ratio: float
    most: float
    error: float = 0.0

    @property
    def finite_ratio(self) -> float:
        """What is assumed before more is known."""
        return self.ratio if np.isfinite(self.ratio) else max(self.least, 1.0)


NO_REPEATS = RepeatedNoise(frames=0, least=1.0, ratio=1.0, most=1.0)


@dataclass(frozen=True, kw_only=True)
class PixelNoise:
    """Noise of a pixel: a curve over its brightness, times one factor a frame.

    The factor describes what differs between frames, such as background light.

    Attributes:
        knots: Logarithms of the brightness (`brightness_of`), increasing, shape (B,).
        sigma: Standard deviation at the knots, shape (B,), metres.
        factor: Of every frame, shape (F,).
        repeated: What frames taken without moving say. Without them the level comes from
            differences between neighbouring pixels, and is an upper bound.
        error: Relative error of what differences between neighbours say, two standard errors.
        least, most: Smallest and largest noise that is possible, over this one.
    """

    knots: np.ndarray
    sigma: np.ndarray
    factor: np.ndarray
    repeated: RepeatedNoise = NO_REPEATS
    error: float = 0.0
    least: float = 1.0
    most: float = 1.0

    @property
    def repeats(self) -> int:
        """Number of frames taken without moving that the level comes from."""
        return self.repeated.frames

    def at(self, brightness: Tensor, frame: Tensor) -> Tensor:
        """Return the standard deviation of pixels of this brightness and frame, (M,), metres."""
        return torch.from_numpy(self.at_numpy(brightness.numpy(), frame.numpy()))

    def at_numpy(self, brightness: np.ndarray, frame: np.ndarray) -> np.ndarray:
        """Return the same for NumPy arrays (M,)."""
        at = np.log(np.maximum(brightness, 1e-12))
        return np.exp(np.interp(at, self.knots, np.log(self.sigma))) * self.factor[frame]

    def limits(self, level: float) -> tuple[float, float, float]:
        """Return the least, likeliest and largest noise over what neighbours' differences see.

        They see all of it but what neighbours share, and fine structure too. Without repeats what
        neighbours share may be structure. Repeats do not see what a filter over time leaves alike.
        Where they say more than neighbours allow, either may be right.

        Args:
            level: Noise over what those differences see of it, where neighbours share some.
        """
        repeated, bound = self.repeated, level * (1 + self.error)
        if not repeated.frames:
            return 1 - self.error, level, bound
        seen = bool(np.isfinite(repeated.ratio))
        ratio = max(min(repeated.ratio, bound if seen else level), repeated.least)
        most = min(repeated.most * (1 + repeated.error), bound)
        most = max(most, ratio, repeated.ratio if seen else 0.0)
        return repeated.least * (1 - repeated.error), ratio, most

    def held_to_neighbours(self, level: float, striped: bool = False) -> "PixelNoise":
        """Return the noise within `limits`.

        Args:
            level: Noise over what differences between neighbours see of it.
            striped: Whether repeats differ by structure too, of which those differences see less.
        """
        kept = replace(self, repeated=NO_REPEATS) if striped else self
        least, ratio, most = kept.limits(level)
        sigma = ratio / self.repeated.finite_ratio * self.sigma
        return replace(kept, sigma=sigma, least=least / ratio, most=most / ratio)


def brightness_of(observations: Observations) -> Tensor:
    """Return what the noise depends on, shape (M,): amplitude, or 1 / distance^2 without it."""
    if observations.amplitude is not None:
        return observations.amplitude
    return 1.0 / observations.measured.clamp(min=1e-3) ** 2


def gap_weight(sigma: Tensor) -> Tensor:
    """Return the weight of pixels of this noise (M,) in a gap in millimetres, 0 to 1."""
    return 1 / (1 + (sigma / _HALF_WEIGHT_SIGMA) ** 2)


MAD_TO_SIGMA = 1.4826
"""Standard deviation over median absolute deviation of a normal distribution, rounded.

`tofcorr.spread` has more digits. They would change every published figure in the sixth digit.
"""
GROSS = 8.0
"""Values beyond this many robust standard deviations are gross errors: they count neither in a fit
nor in the noise. Chosen; noise does not reach it."""
# Residuals beyond this many robust standard deviations get a weight that falls as 1 / size (Huber).
# Chosen; it is reached by 1 in 16 000 normal residuals.
_HUBER = 4.0
# Pixels in a group whose median residual counts as common, and the largest common value, metres.
# Chosen: a gross error of one pixel cannot move the median of 32.
_PER_GROUP = 32.0
_MOST_COMMON = 0.1


class Neighbours:
    """Groups of neighbouring pixels that are equally bright.

    A group holds the pixels of one image that lie in the same square and on the same side of that
    square's median brightness.
    """

    def __init__(self, observations: Observations) -> None:
        camera = observations.recording.camera
        pixel, frame = observations.pixel, observations.frame
        seen = float(observations.on_target.double().sum())
        density = len(pixel) / max(seen, 1.0)
        side = max(2, round((_PER_GROUP / min(density, 1.0)) ** 0.5))
        across = camera.width // side + 1
        tile = pixel // camera.width // side * across + pixel % camera.width // side
        group = frame * (across * (camera.height // side + 1)) + tile
        brightness = brightness_of(observations)
        middle = _Groups(group).median(brightness)
        self._groups = _Groups(2 * group + (brightness > middle).long())

    def common(self, residual: Tensor) -> Tensor:
        """Return what each pixel's residual has in common with its group, shape (M,), metres.

        This is the median, clamped to 0.1 m. A gross error of a single pixel does not change it.
        Saturation of a bright patch does, however large it is.
        """
        return self._groups.median(residual).clamp(-_MOST_COMMON, _MOST_COMMON)


class _Groups:
    """Groups of values: a row for each group, filled up with infinity.

    Args:
        number: Of each value's group, shape (M,), int64.
    """

    def __init__(self, number: Tensor) -> None:
        self._order = number.argsort(stable=True)
        _, row, count = number[self._order].unique_consecutive(
            return_inverse=True, return_counts=True
        )
        place = torch.arange(len(row)) - (count.cumsum(0) - count)[row]
        self._count, self._width = count, int(count.max())
        self._place = row * self._width + place
        self._row = torch.empty_like(row).index_copy(0, self._order, row)

    def median(self, values: Tensor) -> Tensor:
        """Return the (lower) median of each value's group, shape (M,)."""
        rows = torch.full((len(self._count) * self._width,), torch.inf, dtype=values.dtype)
        rows[self._place] = values[self._order]
        ranked = rows.reshape(len(self._count), -1).sort(dim=1).values
        middle = ranked.gather(1, (self._count - 1)[:, None] // 2)[:, 0]
        return middle[self._row]


def robust_weights(residual: Tensor, sigma: Tensor, common: Tensor | None = None) -> Tensor:
    """Return 1 for ordinary residuals, less for large ones and 0 for gross ones, shape (M,).

    The scale is at least the robust standard deviation of the residuals, so that an effect of
    ordinary size keeps its weight.

    Args:
        residual: Shape (M,), metres.
        sigma: Noise of the pixels, shape (M,), metres.
        common: What each pixel has in common with its neighbours, shape (M,), metres; it is
            subtracted first. None: nothing.
    """
    residual = residual if common is None else residual - common
    ratio = residual / sigma
    typical = MAD_TO_SIGMA * float((ratio - ratio.median()).abs().median())
    scale = sigma * max(typical, 1.0)
    size = (residual - residual.median()).abs() / scale
    return torch.where(size > GROSS, 0.0, (_HUBER / size.clamp(min=1e-12)).clamp(max=1.0))


def no_gross_error(values: np.ndarray) -> np.ndarray:
    """Return which values, of mean zero and equal spread, are no gross errors, shape (M,), bool.

    The ordinary standard deviation replaces the robust one where most values are equal, as in
    coarsely rounded depth.
    """
    if not len(values):
        return np.ones(0, dtype=bool)
    scale = MAD_TO_SIGMA * np.median(np.abs(values)) or np.sqrt(np.mean(values**2))
    return np.abs(values) <= GROSS * scale


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
_LEAST_OUTSIDE = 50
# Most groups of such pixels on either side of the measured ones. Chosen; the law is smooth.
_MOST_OUTSIDE = 8
# Least ratio of squares. Chosen: residuals may be equal where depth is rounded.
_LEAST_SQUARE_RATIO = 1e-3
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
    law = _fitted_law(_columns(at - middle), variance, count)
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
        if len(chosen) < _LEAST_OUTSIDE:
            continue
        groups = np.array_split(
            chosen[np.argsort(at[chosen])], min(len(chosen) // _LEAST_OUTSIDE, _MOST_OUTSIDE)
        )
        for members in groups:
            ratio = ratios[members]
            ratio = ratio[no_gross_error(ratio)]
            middle = float(np.median(at[members]))
            own = np.exp(np.interp(middle, noise.knots, np.log(noise.sigma)))
            middles.append(np.array([middle]))
            square = float(np.mean(ratio**2))
            variances.append(np.array([np.clip(square, _LEAST_SQUARE_RATIO, most) * own**2]))
    middle, variance = np.concatenate(middles), np.concatenate(variances)
    order = np.argsort(middle)
    count = np.full(len(middle), _KNOWN_COUNT)
    knots, sigma = noise_curve(np.exp(middle[order]), variance[order], count)
    return replace(noise, knots=knots, sigma=sigma)


def _columns(log_brightness: np.ndarray) -> np.ndarray:
    """Return 1 / A, 1 / A^2 and 1, shape (B, 3)."""
    dark = np.exp(-log_brightness)
    return np.stack([dark, dark**2, np.ones_like(dark)], axis=1)


def _fitted_law(columns: np.ndarray, variance: np.ndarray, count: np.ndarray) -> np.ndarray:
    """Fit the law, weighted by the error of each variance, 2 / count of its square."""
    from scipy.optimize import nnls  # A quarter of the time of torch to import.

    expected, law = variance, np.zeros(3)
    for _ in range(_ROUNDS):
        weight = np.sqrt(count) / expected
        level = float(np.average(variance / columns[:, 0], weights=count))
        prior = np.sqrt(_SHOT_COUNT) / max(level, 1e-30) * np.eye(3)[1:]
        left = np.concatenate([columns * weight[:, None], prior])
        right = np.concatenate([variance * weight, np.zeros(2)])
        law = nnls(left, right)[0]
        expected = np.maximum(columns @ law, 1e-3 * variance)
    return law


# Frames of one pose, target and exposure count as repeats from this number on. Two give one degree
# of freedom in each of thousands of pixels.
_LEAST_FRAMES = 2
# r counts from this many standard errors on. The usual convention, one-sided 2.5 %.
_SIGNIFICANT = 2.0
# Least ratio of measured to modelled noise. Chosen: repeats may be equal where depth is rounded.
_LEAST_RATIO = 1e-6
# Largest relative error of the ratio. Chosen, as for differences between neighbours.
_MOST_ERROR = 0.5
# Largest r. Chosen: beyond it frames hardly differ, and nothing can be said.
_MOST_KEPT = 0.9


class _Group(NamedTuple):
    """Sums over the frames of one pose, per tile of the image, weighted.

    Attributes:
        frames: Number of frames.
        square: Sum of squared deviations from the mean frame, over the degrees of freedom and times
            `frames`.
        model: What the noise model expects of `square`.
        apart: Of frames one and two apart: half the squared differences, a mean over the pairs,
            shape (2, T).
    """

    frames: int
    square: float
    model: float
    apart: np.ndarray


def repeated_noise(observations: Observations, noise: PixelNoise) -> RepeatedNoise:
    """Compare the variation over repeated frames with the noise model."""
    groups = [
        group
        for members in same_exposure(observations)
        if len(members) >= _LEAST_FRAMES
        and (group := _group(observations, noise, members)) is not None
    ]
    if not groups:
        return NO_REPEATS
    least, kept, most = _kept_share(groups)
    return RepeatedNoise(
        frames=sum(group.frames for group in groups),
        least=_ratio(groups, least),
        ratio=np.inf if most is None else _ratio(groups, kept),
        most=np.inf if most is None else _ratio(groups, most),
        error=_ratio_error(groups, kept),
    )


def _group(observations: Observations, noise: PixelNoise, members: np.ndarray) -> _Group | None:
    images = observations.distance_images[members].double()
    use = (images > 0).all(0) & observations.on_target[members].all(0)
    if not use.any():
        return None
    freedom = (len(members) - 1) / len(members)
    brightness = 1.0 / images[:, use].mean(0) ** 2
    if observations.amplitude_images is not None:
        brightness = observations.amplitude_images[members].double()[:, use].mean(0)
    at = torch.full(brightness.shape, int(members[0]))
    expected = noise.at(brightness, at)
    kept = _without_gross_errors(images[:, use], expected)
    if not kept.any():
        return None
    use[use.clone()] = kept
    values, expected = images[:, use], expected[kept]
    values = values - values.mean(1, keepdim=True)
    around = values - values.mean(0)
    weight = gap_weight(expected)
    tile = tiles_of(use.numpy())
    apart = [
        _per_tile(weight * (around[lag:] - around[:-lag]).square().mean(0) / 2, tile)
        for lag in (1, 2)
        if lag < len(members)
    ]
    return _Group(
        frames=len(members),
        square=float((weight * around**2).sum()) / freedom,
        model=float((weight * expected**2).sum()) * len(members),
        apart=np.stack(apart),
    )


def _without_gross_errors(values: Tensor, expected: Tensor) -> Tensor:
    """Return the pixels, (M,), that have a gross error in no frame.

    Args:
        values: Distances, shape (N, M), metres.
        expected: Noise of each pixel, shape (M,), metres.
    """
    values = values - values.median(1, keepdim=True).values
    ratio = ((values - values.mean(0)) / expected).numpy()
    return torch.from_numpy(no_gross_error(ratio.ravel()).reshape(ratio.shape).all(0))


def _per_tile(values: Tensor, tile: np.ndarray) -> np.ndarray:
    return np.bincount(tile, values.numpy())


def _kept_share(groups: list[_Group]) -> tuple[float, float, float | None]:
    """Return the least, likeliest and largest share that a frame may keep of the one before.

    The first two are 0 where the share is not significant. The largest is None where no pose has
    three frames that fill two tiles.
    """
    long = [group for group in groups if group.frames > 2]
    if not long:
        return 0.0, 0.0, None
    value, error = frame_correlation(np.concatenate([group.apart for group in long], axis=1))
    if np.isnan(value):
        return 0.0, 0.0, None
    kept, reach = float(np.clip(value, 0.0, _MOST_KEPT)), _SIGNIFICANT * error
    least = max(min(value - reach, kept), 0.0)
    return least, kept if kept > reach else 0.0, min(kept + reach, _MOST_KEPT)


def _ratio(groups: list[_Group], kept: float) -> float:
    """Return the root of measured over modelled mean square, if frames keep this share."""
    model = sum(group.model * (1 - mean_correlation(kept, group.frames)) for group in groups)
    measured = sum(group.square for group in groups)
    return max(float(np.sqrt(measured / model)), _LEAST_RATIO)


def _ratio_error(groups: list[_Group], kept: float) -> float:
    """Return the relative error of the ratio, two standard errors, by leaving out one pose each.

    Poses show other brightnesses, at which the model of the noise may be off by more or less.
    """
    if len(groups) < 2:
        return 0.0
    whole = _ratio(groups, kept)
    without = [_ratio([*groups[:k], *groups[k + 1 :]], kept) for k in range(len(groups))]
    spread = float(np.sum((np.array(without) - np.mean(without)) ** 2))
    error = _SIGNIFICANT * float(np.sqrt((len(groups) - 1) / len(groups) * spread)) / whole
    return min(error, _MOST_ERROR)


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
    noise = _fitted_noise(differences, observations.num_frames)
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


def _fitted_noise(differences: _Differences, num_frames: int) -> PixelNoise:
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
