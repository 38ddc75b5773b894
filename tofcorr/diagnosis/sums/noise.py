r"""The noise of each pixel, from neighbours, repeated frames and residuals; and robust weights.

The standard deviation is a curve over a pixel's brightness, times a factor for each frame. Second
differences between neighbours give both, less the fixed pattern. The curve is held to the physics
where few pixels say it: with amplitude A, shot noise, read noise or background light, and rounding
or jitter give the depth the variance

.. math:: s^2(A) = \frac{a}{A} + \frac{b}{A^2} + c , \qquad a, b, c \ge 0 .

This law is fitted to the variances measured at some brightnesses. Each of these is then averaged
with the law's, so that many differences give a curve of any form, and few give the law. Beyond the
darkest and the brightest one the law goes on, and residuals say how far it is right.

The level comes from repeated frames where there are any. They differ by noise alone. A filter that
keeps the share r of the frame before leaves noise of variance s^2 with a correlation of r^k over k
frames, so that frames k apart differ by

.. math:: \gamma_k = \tfrac12 E (x_t - x_{t+k})^2 = s^2 (1 - r^k), \qquad
          \gamma_2 / \gamma_1 = 1 + r .

Three frames of a pose give r, and with it s^2. Two do not.
"""

from dataclasses import dataclass, replace
from typing import ClassVar, NamedTuple

import numpy as np
import torch
from torch import Tensor

from tofcorr.diagnosis.sums.observations import (
    TINY,
    Observations,
    frame_chunks,
    predicted_images,
    same_exposure,
)
from tofcorr.estimation.noise import (
    SAME_BRIGHTNESS,
    SECOND_DIFFERENCE,
    SPACING,
    frame_correlation,
    mean_correlation,
    tiles_of,
)

FLOOR_ERROR = 0.05
"""Relative uncertainty of the floor from repeats or neighbouring pixels. Chosen; a test compares
the noise estimate with the truth of a simulator to this accuracy."""
MAD_TO_SIGMA = 1.4826
"""Standard deviation over median absolute deviation of a normal distribution, rounded.

`tofcorr.spread` has more digits. They would change every published figure in the sixth digit.
"""
GROSS = 8.0
"""Values beyond this many robust standard deviations are gross errors: they count neither in a fit
nor in the noise. Chosen; noise does not reach it."""
# The noise of a usual camera, metres. It is taken where no two neighbours can be compared; and a
# pixel of this noise has half a weight in a mean square in millimetres: the gaps of interest are a
# few millimetres, and noisier pixels cannot show them. Chosen.
_USUAL_SIGMA = 0.005
# Least brightness, in any unit: its logarithm is taken.
_LEAST_BRIGHTNESS = 1e-12
# Noise is never assumed below this, metres, so that weights stay finite without noise.
_LEAST_SIGMA = 1e-5
# What the law counts beside the differences at one brightness, as a number of differences. Chosen:
# 200 determine a standard deviation to 5 %, about as well as the law describes a camera. And the
# weight of two priors: that noise is shot noise, a / A, and that the factor of a frame is one.
_LAW_COUNT, _PRIOR_COUNT = 200.0, 20.0
# Number of solutions of the law, and of curve and frames' factors in turn: the weights of each come
# from the one before.
_ROUNDS = 3
# The law is used over this range of log brightness beyond the measured ones, a factor of e^3 = 20,
# at so many points: its logarithm bends little between them. Beyond it stays constant, so that
# pixels without signal get no absurd value. Chosen.
_BEYOND, _POINTS = 3.0, 6
# Fewest pixels or differences of like brightness that say its noise: 50 determine a standard
# deviation to 10 %. Most groups of them among all that were compared, and beyond these on either
# side. Chosen; the law is smooth.
_LEAST_PER_KNOT, _MOST_KNOTS, _MOST_BEYOND = 50, 24, 8
# Least ratio of measured to modelled mean square: values may be equal where depth is rounded; and
# the least share of the variance of differences that is noise, whatever share the fixed pattern
# seems to explain. Chosen.
_LEAST_RATIO, _LEAST_NOISE_SHARE = 1e-3, 0.05
# Something counts from this many standard errors on. The usual convention.
_SIGNIFICANT = 2.0
# Largest relative error of a level, and the largest share that a frame may keep of the one before:
# beyond it frames hardly differ, and nothing can be said. Chosen.
_MOST_ERROR, _MOST_KEPT = 0.5, 0.9
# Of larger recordings only every k-th row is read: about this many pixels in all, and at most so
# many at a time. Chosen to bound time and memory.
_MOST_PIXELS, _CHUNK_PIXELS = 4_000_000, 500_000


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

    frames: int = 0
    least: float = 1.0
    ratio: float = 1.0
    most: float = 1.0
    error: float = 0.0

    @property
    def finite_ratio(self) -> float:
        """What is assumed before more is known."""
        return self.ratio if np.isfinite(self.ratio) else max(self.least, 1.0)


NO_REPEATS = RepeatedNoise()


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
        at = np.log(np.maximum(brightness, _LEAST_BRIGHTNESS))
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
    return inverse_square(observations.measured)


def inverse_square(distance: Tensor) -> Tensor:
    """Return 1 / distance^2, what the light of a target falls with; not nearer than 1 mm."""
    return distance.clamp(min=1 / 1000) ** -2


def gap_weight(sigma: Tensor) -> Tensor:
    """Return the weight of pixels of this noise (M,) in a gap in millimetres, 0 to 1."""
    return 1 / (1 + (sigma / _USUAL_SIGMA) ** 2)


class Neighbours:
    """Groups of neighbouring pixels that are equally bright.

    A group holds the pixels of one image that lie in the same square and on the same side of that
    square's median brightness.

    Class attributes:
        size: Pixels of a square. Chosen: a gross error of one pixel cannot move the median of 32.
        most: Largest common value, metres. Chosen.
    """

    size: ClassVar[float] = 32.0
    most: ClassVar[float] = 0.1

    def __init__(self, observations: Observations) -> None:
        camera, pixel = observations.recording.camera, observations.pixel
        density = len(pixel) / max(float(observations.on_target.double().sum()), 1.0)
        side = max(2, round((self.size / min(density, 1.0)) ** 0.5))
        across = camera.width // side + 1
        tile = pixel // camera.width // side * across + pixel % camera.width // side
        group = observations.frame * (across * (camera.height // side + 1)) + tile
        brightness = brightness_of(observations)
        self._group = 2 * group + (brightness > _group_median(group, brightness)).long()

    def common(self, residual: Tensor) -> Tensor:
        """Return what each pixel's residual has in common with its group, shape (M,), metres.

        This is the median, clamped to 0.1 m. A gross error of a single pixel does not change it.
        Saturation of a bright patch does, however large it is.
        """
        return _group_median(self._group, residual).clamp(-self.most, self.most)


def _group_median(group: Tensor, values: Tensor) -> Tensor:
    """Return the (lower) median of each value's group, shape (M,)."""
    order = values.argsort()
    order = order[group[order].argsort(stable=True)]
    _, row, count = group[order].unique_consecutive(return_inverse=True, return_counts=True)
    middle = values[order][count.cumsum(0) - count + (count - 1) // 2]
    return torch.empty_like(values).index_copy(0, order, middle[row])


def robust_weights(
    residual: Tensor, sigma: Tensor, common: Tensor | None = None, *, huber: float = 4.0
) -> Tensor:
    """Return 1 for ordinary residuals, less for large ones and 0 for gross ones, shape (M,).

    The scale is at least the robust standard deviation of the residuals, so that an effect of
    ordinary size keeps its weight, and structures keep theirs.

    Args:
        residual: Shape (M,), metres.
        sigma: Noise of the pixels, shape (M,), metres.
        common: What each pixel has in common with its neighbours, shape (M,), metres; it is
            subtracted first. None: nothing.
        huber: Residuals beyond this many robust standard deviations get a weight that falls as 1 /
            size (Huber). Chosen; it is reached by 1 in 16 000 normal residuals.
    """
    residual = residual if common is None else residual - common
    ratio = residual / sigma
    typical = MAD_TO_SIGMA * float((ratio - ratio.median()).abs().median())
    size = (residual - residual.median()).abs() / (sigma * max(typical, 1.0))
    return torch.where(size > GROSS, 0.0, (huber / size.clamp(min=huber)))


def no_gross_error(values: np.ndarray) -> np.ndarray:
    """Return which values, of mean zero and equal spread, are no gross errors, shape (M,), bool.

    The ordinary standard deviation replaces the robust one where most values are equal, as in
    coarsely rounded depth.
    """
    if not len(values):
        return np.ones(0, dtype=bool)
    scale = MAD_TO_SIGMA * np.median(np.abs(values)) or np.sqrt(np.mean(values**2))
    return np.abs(values) <= GROSS * scale


def noise_curve(
    brightness: np.ndarray, variance: np.ndarray, count: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return knots of log brightness and standard deviations there, both (B + 12,).

    Args:
        brightness: Where the noise was measured, ascending, positive, shape (B,).
        variance: Measured, positive, shape (B,), m^2.
        count: Number of squares behind each, shape (B,).
    """
    from scipy.optimize import nnls  # A quarter of the time of torch to import.

    at = np.log(brightness)

    def columns(log_brightness: np.ndarray) -> np.ndarray:
        dark = np.exp(at[len(at) // 2] - log_brightness)
        return np.stack([dark, dark**2, np.ones_like(dark)], axis=1)

    measured, expected, law = columns(at), variance, np.zeros(3)
    for _ in range(_ROUNDS):
        # The error of a variance is 2 / count of its square.
        weight = np.sqrt(count) / expected
        level = float(np.average(variance / measured[:, 0], weights=count))
        prior = np.sqrt(_PRIOR_COUNT) / max(level, TINY) * np.eye(3)[1:]
        left = np.concatenate([measured * weight[:, None], prior])
        law = nnls(left, np.concatenate([variance * weight, np.zeros(2)]))[0]
        expected = np.maximum(measured @ law, _LEAST_RATIO * variance)
    mixed = (count * variance + _LAW_COUNT * (measured @ law)) / (count + _LAW_COUNT)
    away = _BEYOND * np.arange(1, _POINTS + 1) / _POINTS
    darker, brighter = at[0] - away[::-1], at[-1] + away
    # The law goes on from what the mixture says at the ends.
    first, last = mixed[[0, -1]] / (measured[[0, -1]] @ law)
    variances = first * (columns(darker) @ law), mixed, last * (columns(brighter) @ law)
    return np.concatenate([darker, at, brighter]), np.sqrt(np.concatenate(variances))


def with_residuals(
    noise: PixelNoise,
    brightness: Tensor,
    frame: Tensor,
    deviation: Tensor,
    *,
    known_count: float = 1e5,
) -> PixelNoise:
    """Return the noise that pixels show which are darker or brighter than all compared neighbours.

    Args:
        noise: Estimated from neighbours of like brightness.
        brightness: Of each pixel, shape (M,).
        frame: Frame of each pixel, shape (M,).
        deviation: Of its residual from those of its neighbours, shape (M,), metres.
        known_count: What counts as well known, as a number of differences. Chosen, far above what
            the law counts.
    """
    at = np.log(np.maximum(brightness.numpy(), _LEAST_BRIGHTNESS))
    ratios = (deviation / noise.at(brightness, frame)).numpy()
    known = slice(_POINTS, len(noise.knots) - _POINTS)
    middle, variance = list(noise.knots[known]), list(noise.sigma[known] ** 2)
    darker, brighter = at < middle[0], at > middle[-1]
    # Brighter pixels have no more noise than the law says: what is more there, saturation makes.
    for outside, most in ((darker, np.inf), (brighter, 1.0)):
        chosen = np.flatnonzero(outside)
        count = min(len(chosen) // _LEAST_PER_KNOT, _MOST_BEYOND)
        for members in np.array_split(chosen[np.argsort(at[chosen])], count) if count else ():
            ratio = ratios[members][no_gross_error(ratios[members])]
            middle.append(float(np.median(at[members])))
            own = np.exp(np.interp(middle[-1], noise.knots, np.log(noise.sigma)))
            square = np.clip(np.mean(ratio**2), _LEAST_RATIO, most)
            variance.append(square * own**2)
    order = np.argsort(middle)
    well_known = np.full(len(middle), known_count)
    knots, sigma = noise_curve(
        np.exp(np.array(middle)[order]), np.array(variance)[order], well_known
    )
    return replace(noise, knots=knots, sigma=sigma)


def estimate_noise(observations: Observations, tool_from_camera: Tensor) -> PixelNoise:
    """Estimate the pixel noise from differences between neighbours and from repeated frames.

    Args:
        observations: The pixels and images.
        tool_from_camera: Hand-eye transform, shape (4, 4); its prediction is subtracted first.
    """
    difference, brightness, frame, place = _second_differences(observations, tool_from_camera)
    noise = _by_neighbours(difference, brightness, frame, observations.num_frames)
    fixed = _fixed_square(difference, noise.at_numpy(brightness, frame), place)
    random = np.maximum(noise.sigma**2 - fixed, _LEAST_NOISE_SHARE * noise.sigma**2)
    noise = replace(noise, sigma=np.maximum(np.sqrt(random), _LEAST_SIGMA))
    found = _repeated_noise(observations, noise)
    sigma = np.maximum(noise.sigma * found.finite_ratio, _LEAST_SIGMA)
    # Two standard errors; second differences that overlap count half.
    error = 2 / np.sqrt(max(len(place), 1))
    return replace(noise, sigma=sigma, repeated=found, error=min(error, _MOST_ERROR))


def _second_differences(
    observations: Observations, tool_from_camera: Tensor
) -> tuple[np.ndarray, ...]:
    """Return second differences of the residual along rows, (N,) metres.

    Returns:
        The differences; brightness, frame and place in the image of their middle pixels.
    """
    parts = []
    skip = slice(None, None, max(1, observations.on_target.numel() // _MOST_PIXELS))

    def near(images: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return middle, left and right pixels."""
        return (
            images[:, :, SPACING:-SPACING],
            images[:, :, : -2 * SPACING],
            images[:, :, 2 * SPACING :],
        )

    for part in frame_chunks(observations, _CHUNK_PIXELS):
        measured = observations.distance_images[part][:, skip].double()
        predicted = predicted_images(observations, tool_from_camera, part, skip)
        own, left, right = near(measured - predicted)
        middle = own - (left + right) / 2
        use = near(observations.on_target[part][:, skip] & (measured > 0))
        inside = use[0] & use[1] & use[2] & middle.isfinite()
        if observations.amplitude_images is not None:
            here, left, right = near(observations.amplitude_images[part][:, skip].double())
            around = (right + left) / 2
            for apart in ((right - left).abs(), (here - around).abs()):
                inside &= apart < SAME_BRIGHTNESS * around
        else:
            here = inverse_square(near(predicted)[0])
        frame, row, column = torch.nonzero(inside).unbind(1)
        place = row * inside.shape[2] + column
        parts.append((middle[inside], here[inside], frame + part.start, place))
    return tuple(torch.cat(part).numpy() for part in zip(*parts, strict=True))


def _by_neighbours(
    difference: np.ndarray, brightness: np.ndarray, frame: np.ndarray, num_frames: int
) -> PixelNoise:
    """Fit the curve and the frames' factors in turn; the arguments are as above."""
    ends = np.searchsorted(frame, np.arange(1, num_frames))
    noise = PixelNoise(knots=np.zeros(1), sigma=np.ones(1), factor=np.ones(num_frames))
    if len(difference) < _LEAST_PER_KNOT:
        scale = float(np.mean(difference**2)) if len(difference) else _USUAL_SIGMA**2
        middle = max(float(np.median(brightness)), _LEAST_BRIGHTNESS) if len(brightness) else 1.0
        variance = max(scale / SECOND_DIFFERENCE, _LEAST_SIGMA**2)
        count = max(len(difference), 1)
        knots, sigma = noise_curve(*(np.array([float(x)]) for x in (middle, variance, count)))
        return replace(noise, knots=knots, sigma=sigma)
    count = int(np.clip(len(difference) // _LEAST_PER_KNOT, 1, _MOST_KNOTS))
    groups = np.array_split(np.argsort(brightness, kind="stable"), count)
    counts = np.array([len(members) for members in groups])
    middles = np.array(
        [max(float(np.median(brightness[own])), _LEAST_BRIGHTNESS) for own in groups]
    )
    for _ in range(_ROUNDS):
        variances = []
        for members in groups:
            values = difference[members] / noise.factor[frame[members]]
            values = values - np.median(values)
            square = np.mean(values[no_gross_error(values)] ** 2) / SECOND_DIFFERENCE
            variances.append(max(float(square), _LEAST_SIGMA**2))
        knots, sigma = noise_curve(middles, np.array(variances), counts)
        noise = replace(noise, knots=knots, sigma=sigma, factor=np.ones(num_frames))
        ratio = difference / (noise.at_numpy(brightness, frame) * np.sqrt(SECOND_DIFFERENCE))
        kept = [own[no_gross_error(own)] for own in np.split(ratio, ends)]
        squares = [(np.sum(x**2) + _PRIOR_COUNT) / (len(x) + _PRIOR_COUNT) for x in kept]
        noise = replace(noise, factor=np.sqrt(squares / np.mean(squares)))
    return noise


def _fixed_square(difference: np.ndarray, expected: np.ndarray, place: np.ndarray) -> float:
    """Return the variance of the differences that is the same in all frames, per pixel, m^2.

    It belongs to a fixed pattern, not to the noise. The products of different frames at one place
    estimate it.
    """
    weight = np.where(no_gross_error(difference / expected), expected**-2, 0.0)
    weighted = difference * weight
    total, squares = np.bincount(place, weighted), np.bincount(place, weighted**2)
    pairs = float((np.bincount(place, weight) ** 2 - np.bincount(place, weight**2)).sum())
    if len(place) < _LEAST_PER_KNOT or pairs <= 0:
        return 0.0
    products = float((total**2 - squares).sum())
    spread = squares**2 - np.bincount(place, weighted**4)
    if products < _SIGNIFICANT * float(np.sqrt(2 * spread.sum())):
        return 0.0
    return products / pairs / SECOND_DIFFERENCE


_Group = tuple[int, float, float, np.ndarray]
"""Sums over the frames of one pose, weighted: number of frames; sum of squared deviations from the
mean frame, over the degrees of freedom and times the frames; what the noise model expects of it;
and of frames one and two apart half the squared differences in each tile, shape (2, T)."""


def _repeated_noise(observations: Observations, noise: PixelNoise) -> RepeatedNoise:
    """Compare the variation over repeated frames with the noise model.

    Two frames of one pose, target and exposure are repeats: they give one degree of freedom in each
    of thousands of pixels.
    """
    together = [members for members in same_exposure(observations) if len(members) > 1]
    found = [_repeats(observations, noise, members) for members in together]
    groups = [group for group in found if group is not None]
    if not groups:
        return NO_REPEATS

    def ratio(kept: float, left_out: int | None = None) -> float:
        """Return the root of measured over modelled mean square, if frames keep this share."""
        used = [group for number, group in enumerate(groups) if number != left_out]
        model = sum(own[2] * (1 - mean_correlation(kept, own[0])) for own in used)
        measured = sum(own[1] for own in used)
        return max(float(np.sqrt(measured / model)), _LEAST_RATIO**2)

    least, kept, most = _kept_share([apart for frames, *_, apart in groups if frames > 2])
    error = 0.0
    if len(groups) > 1:
        # Poses show other brightnesses, at which the model of the noise may be off more or less.
        without = np.array([ratio(kept, number) for number in range(len(groups))])
        spread = (len(groups) - 1) / len(groups) * np.sum((without - without.mean()) ** 2)
        error = min(_SIGNIFICANT * float(np.sqrt(spread)) / ratio(kept), _MOST_ERROR)
    return RepeatedNoise(
        frames=sum(group[0] for group in groups),
        least=ratio(least),
        ratio=np.inf if most is None else ratio(kept),
        most=np.inf if most is None else ratio(most),
        error=error,
    )


def _repeats(observations: Observations, noise: PixelNoise, members: np.ndarray) -> _Group | None:
    images = observations.distance_images[members].double()
    use = (images > 0).all(0) & observations.on_target[members].all(0)
    if not use.any():
        return None
    brightness = inverse_square(images[:, use].mean(0))
    if observations.amplitude_images is not None:
        brightness = observations.amplitude_images[members].double()[:, use].mean(0)
    expected = noise.at(brightness, torch.full(brightness.shape, int(members[0])))
    # Pixels with a gross error in any frame do not count.
    values = images[:, use]
    values = values - values.median(1, keepdim=True).values
    ratio = ((values - values.mean(0)) / expected).numpy()
    kept = torch.from_numpy(no_gross_error(ratio.ravel()).reshape(ratio.shape).all(0))
    if not kept.any():
        return None
    use[use.clone()] = kept
    values, expected = images[:, use], expected[kept]
    values = values - values.mean(1, keepdim=True)
    around, weight = values - values.mean(0), gap_weight(expected)
    tile, frames = tiles_of(use.numpy()), len(members)
    apart = [
        np.bincount(tile, (weight * (around[lag:] - around[:-lag]).square().mean(0) / 2).numpy())
        for lag in (1, 2)
        if lag < frames
    ]
    square = float((weight * around**2).sum()) * frames / (frames - 1)
    return frames, square, float((weight * expected**2).sum()) * frames, np.stack(apart)


def _kept_share(apart: list[np.ndarray]) -> tuple[float, float, float | None]:
    """Return the least, likeliest and largest share that a frame may keep of the one before.

    The first two are 0 where the share is not significant. The largest is None where no pose has
    three frames that fill two tiles.

    Args:
        apart: Of each pose of three frames and more, as in `_Group`.
    """
    value, error = frame_correlation(np.concatenate(apart, axis=1)) if apart else (np.nan, 0.0)
    if np.isnan(value):
        return 0.0, 0.0, None
    kept, reach = float(np.clip(value, 0.0, _MOST_KEPT)), _SIGNIFICANT * error
    least = max(min(value - reach, kept), 0.0)
    return least, kept if kept > reach else 0.0, min(kept + reach, _MOST_KEPT)
