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

import numpy as np
import torch
from torch import Tensor

from tofcorr.data.recording import repeats_of
from tofcorr.diagnosis.sums.observations import (
    TINY,
    Observations,
    frame_chunks,
    predicted_images,
)
from tofcorr.estimation.noise import (
    SAME_BRIGHTNESS,
    SECOND_DIFFERENCE,
    SPACING,
    brightness_bins,
    frame_correlation,
    mean_correlation,
    tiles_of,
)
from tofcorr.estimation.robust import sigma_from_mad
from tofcorr.plausibility.finding import FAR_OFF

FLOOR_ERROR = 0.05
"""Relative uncertainty of the floor from repeats or neighbouring pixels. Chosen; a test compares
the noise estimate with the truth of a simulator to this accuracy."""
GROSS = 8.0
"""Values beyond this many robust standard deviations are gross errors: they count neither in a fit
nor in the noise. Chosen; noise does not reach it."""
# The noise of a usual camera, metres. It is taken where no neighbours can be compared; and a pixel
# of this noise has half a weight in a mean square in millimetres: the gaps of interest are a few
# millimetres, and noisier pixels cannot show them. Chosen.
_USUAL_SIGMA = 0.005
# Noise is never assumed below this, metres, so that weights stay finite without noise.
_LEAST_SIGMA = 1e-5
# What the law counts beside the differences at one brightness, as a number of differences. Chosen:
# 200 determine a standard deviation to 5 %, about as well as the law describes a camera. And the
# weight of two priors: that noise is shot noise, a / A, and that the factor of a frame is one.
_LAW_COUNT, _PRIOR_COUNT = 200.0, 20.0
# Points at which the curve goes on at either end of what was measured: the logarithm of the law
# bends little between them.
_POINTS = 6
# Fewest pixels or differences of like brightness that say its noise: 50 determine a standard
# deviation to 10 %.
_LEAST_PER_KNOT = 50
LEAST_RATIO = 1e-3
"""Least ratio of measured to modelled mean square: values may be equal where depth is rounded."""


@dataclass(frozen=True, kw_only=True)
class PixelNoise:
    """Noise of a pixel: a curve over its brightness, times one factor a frame.

    The factor describes what differs between frames, such as background light.

    Attributes:
        knots: Logarithms of the brightness (`brightness_of`), increasing, shape (B,).
        sigma: Standard deviation at the knots, shape (B,), metres.
        factor: Of every frame, shape (F,).
        error: Relative error of what differences between neighbours say, two standard errors.
        repeats: Number of frames taken without moving that the level comes from. Without them it
            comes from differences between neighbouring pixels, and is an upper bound.
        ratios: What repeats say, over what differences between neighbours say: root mean square
            with the weakest filter over time that repeats do not exclude, with the one that they
            show, and with the strongest. The last is infinite where no pose has three frames: any
            filter is possible.
        spread: Relative error of these by how much poses differ, two standard errors; 0 of a single
            pose.
    """

    knots: np.ndarray
    sigma: np.ndarray
    factor: np.ndarray
    error: float = 0.0
    repeats: int = 0
    ratios: tuple[float, float, float] = (1.0, 1.0, 1.0)
    spread: float = 0.0

    def at(self, brightness: Tensor, frame: Tensor) -> Tensor:
        """Return the standard deviation of pixels of this brightness and frame, (M,), metres."""
        return torch.from_numpy(self.at_numpy(brightness.numpy(), frame.numpy()))

    def at_numpy(self, brightness: np.ndarray, frame: np.ndarray | int) -> np.ndarray:
        """Return the same for NumPy arrays (M,), or one frame."""
        at = np.log(np.maximum(brightness, TINY))
        return np.exp(np.interp(at, self.knots, np.log(self.sigma))) * self.factor[frame]

    def limits(self, level: float) -> tuple[float, float, float]:
        """Return the least, likeliest and largest noise over what neighbours' differences see.

        They see all of it but what neighbours share, and fine structure too. Without repeats what
        neighbours share may be structure. Repeats do not see what a filter over time leaves alike.
        Where they say more than neighbours allow, either may be right.

        Args:
            level: Noise over what those differences see of it, where neighbours share some.
        """
        bound = level * (1 + self.error)
        if not self.repeats:
            return 1 - self.error, level, bound
        least, shown, most = self.ratios
        seen = np.isfinite(most)
        ratio = max(min(shown, bound) if seen else level, least)
        most = max(min(most * (1 + self.spread), bound), ratio, shown if seen else 0.0)
        return least * (1 - self.spread), ratio, most

    def held_to_neighbours(self, level: float, striped: bool = False) -> "PixelNoise":
        """Return the noise within `limits`.

        Args:
            level: Noise over what differences between neighbours see of it.
            striped: Whether repeats differ by structure too, of which those differences see less.
        """
        held = replace(self, repeats=0 if striped else self.repeats)
        return replace(held, sigma=held.limits(level)[1] / self.ratios[1] * self.sigma)


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


def common_of_neighbours(observations: Observations, residual: Tensor) -> Tensor:
    """Return what each residual has in common with equally bright neighbours, shape (M,), metres.

    This is the median of the pixels of one image that lie in the same square and on the same side
    of that square's median brightness. A gross error of a single pixel does not change it.
    Saturation of a bright patch does, however large it is, up to `FAR_OFF`.

    Args:
        observations: The pixels.
        residual: Of the pixels, shape (M,), metres.
    """
    camera, pixel = observations.recording.camera, observations.pixel
    # A gross error of one pixel cannot move the median of 32.
    side = max(2, round((32 / observations.density) ** 0.5))
    across, down = (length // side + 1 for length in (camera.width, camera.height))
    tile = pixel // camera.width // side * across + pixel % camera.width // side
    group = observations.frame * (across * down) + tile
    brightness = brightness_of(observations)
    group = 2 * group + (brightness > _group_median(group, brightness)).long()
    return _group_median(group, residual).clamp(-FAR_OFF, FAR_OFF)


def _group_median(group: Tensor, values: Tensor) -> Tensor:
    """Return the (lower) median of each value's group, shape (M,)."""
    order = values.argsort()
    order = order[group[order].argsort(stable=True)]
    _, row, count = group[order].unique_consecutive(return_inverse=True, return_counts=True)
    middle = values[order][count.cumsum(0) - count + (count - 1) // 2]
    return torch.empty_like(values).index_copy(0, order, middle[row])


def robust_weights(residual: Tensor, sigma: Tensor, common: Tensor | float = 0.0) -> Tensor:
    """Return 1 for ordinary residuals, less for large ones and 0 for gross ones, shape (M,).

    The scale is at least the robust standard deviation of the residuals, so that an effect of
    ordinary size keeps its weight, and structures keep theirs.

    Args:
        residual: Shape (M,), metres.
        sigma: Noise of the pixels, shape (M,), metres.
        common: What each pixel has in common with its neighbours, shape (M,), metres; it is
            subtracted first.
    """
    residual = residual - common
    ratio = residual / sigma
    typical = sigma_from_mad(float((ratio - ratio.median()).abs().median()))
    size = (residual - residual.median()).abs() / (sigma * max(typical, 1.0))
    # Beyond four standard deviations, as 1 in 16 000 normal residuals, the weight falls as 1 / size
    # (Huber). Chosen.
    return torch.where(size > GROSS, 0.0, 4.0 / size.clamp(min=4.0))


def no_gross_error(values: np.ndarray) -> np.ndarray:
    """Return which values, of mean zero and equal spread, are no gross errors, shape (M,), bool.

    The ordinary standard deviation replaces the robust one where most values are equal, as in
    coarsely rounded depth.
    """
    size = np.abs(values)
    scale = sigma_from_mad(np.median(size)) or np.sqrt(np.mean(size**2)) if len(size) else 0.0
    return size <= GROSS * scale


def noise_curve(
    brightness: np.ndarray, variance: np.ndarray, count: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return knots of log brightness and standard deviations there, both (B + 12,).

    Beyond the measured brightnesses the law is used up to a factor of e^3 = 20. There the curve
    stays constant, so that pixels without signal get no absurd value.

    Args:
        brightness: Where the noise was measured, ascending, positive, shape (B,).
        variance: Measured, positive, shape (B,), m^2.
        count: Number of squares behind each, shape (B,).
    """
    from scipy.optimize import nnls  # A quarter of the time of torch to import.

    at = np.log(brightness)
    away = np.linspace(3.0 / _POINTS, 3.0, _POINTS)
    knots = np.concatenate([at[0] - away[::-1], at, at[-1] + away])
    columns = np.exp(at[len(at) // 2] - knots)[:, None] ** [1.0, 2.0, 0.0]
    measured = columns[_POINTS:-_POINTS]
    expected, law = variance, np.zeros(3)
    for _ in range(3):  # The weights of each solution come from the one before.
        # The error of a variance is 2 / count of its square.
        weight = np.sqrt(count) / expected
        level = float(np.average(variance / measured[:, 0], weights=count))
        prior = np.sqrt(_PRIOR_COUNT) / max(level, TINY) * np.eye(3)[1:]
        left = np.concatenate([measured * weight[:, None], prior])
        law = nnls(left, np.concatenate([variance * weight, np.zeros(2)]))[0]
        expected = np.maximum(measured @ law, LEAST_RATIO * variance)
    mixed = (count * variance + _LAW_COUNT * (measured @ law)) / (count + _LAW_COUNT)
    # The law goes on from what the mixture says at the ends.
    first, last = mixed[[0, -1]] / (measured[[0, -1]] @ law)
    ends = columns @ law * np.where(knots < at[0], first, last)
    ends[_POINTS:-_POINTS] = mixed
    return knots, np.sqrt(ends)


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
    at = np.log(np.maximum(brightness.numpy(), TINY))
    ratios = (deviation / noise.at(brightness, frame)).numpy()
    inside = slice(_POINTS, -_POINTS)
    known = list(zip(noise.knots[inside], noise.sigma[inside] ** 2, strict=True))
    # Brighter pixels have no more noise than the law says: what is more there, saturation makes.
    for outside, most in ((at < known[0][0], np.inf), (at > known[-1][0], 1.0)):
        chosen = np.flatnonzero(outside)
        # Eight groups say how a smooth law goes on.
        count = min(len(chosen) // _LEAST_PER_KNOT, 8)
        for members in np.array_split(chosen[np.argsort(at[chosen])], count) if count else ():
            ratio = ratios[members][no_gross_error(ratios[members])]
            middle = float(np.median(at[members]))
            own = np.exp(np.interp(middle, noise.knots, np.log(noise.sigma)))
            known.append((middle, np.clip(np.mean(ratio**2), LEAST_RATIO, most) * own**2))
    middles, variances = np.array(sorted(known)).T
    # All of it is well known: far beyond what the law counts.
    well_known = np.full(len(known), 500 * _LAW_COUNT)
    knots, sigma = noise_curve(np.exp(middles), variances, well_known)
    return replace(noise, knots=knots, sigma=sigma)


def estimate_noise(observations: Observations, tool_from_camera: Tensor) -> PixelNoise:
    """Estimate the pixel noise from differences between neighbours and from repeated frames.

    Args:
        observations: The pixels and images.
        tool_from_camera: Hand-eye transform, shape (4, 4); its prediction is subtracted first.
    """
    difference, brightness, frame, place = _second_differences(observations, tool_from_camera)
    if len(difference) < _LEAST_PER_KNOT:  # The law from the usual noise at the usual brightness.
        usual = brightness_of(observations).median().clamp(min=TINY).numpy()[None]
        knots, sigma = noise_curve(usual, np.array([_USUAL_SIGMA**2]), np.ones(1))
        noise = PixelNoise(knots=knots, sigma=sigma, factor=np.ones(observations.num_frames))
    else:
        noise = _by_neighbours(difference, brightness, frame, observations.num_frames)
        fixed = _fixed_square(difference, noise.at_numpy(brightness, frame), place)
        # Some of it is noise, whatever share the fixed pattern seems to explain.
        random = np.maximum(noise.sigma**2 - fixed, noise.sigma**2 / 20)
        noise = replace(noise, sigma=np.maximum(np.sqrt(random), _LEAST_SIGMA))
    noise = _with_repeats(observations, noise)
    # Two standard errors, at most half; second differences that overlap count half.
    error = min(2 / np.sqrt(max(len(place), 1)), 0.5)
    sigma = np.maximum(noise.sigma * noise.ratios[1], _LEAST_SIGMA)
    return replace(noise, sigma=sigma, error=error)


def _second_differences(
    observations: Observations, tool_from_camera: Tensor
) -> tuple[np.ndarray, ...]:
    """Return second differences of the residual along rows, (N,) metres.

    Returns:
        The differences; brightness, frame and place in the image of their middle pixels.
    """
    parts = []
    # Of larger recordings only every k-th row is read: about four million pixels.
    skip = slice(None, None, max(1, observations.on_target.numel() // 4_000_000))

    def near(images: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return left, middle and right pixels."""
        width = images.shape[2] - 2 * SPACING
        left, middle, right = (images[:, :, k * SPACING :][:, :, : max(width, 0)] for k in range(3))
        return left, middle, right

    for part in frame_chunks(observations):
        measured = observations.distance_images[part][:, skip].double()
        predicted = predicted_images(observations, tool_from_camera, part, skip)
        left, own, right = near(measured - predicted)
        difference = own - (left + right) / 2
        used = near(observations.on_target[part][:, skip] & (measured > 0))
        inside = used[0] & used[1] & used[2] & difference.isfinite()
        if observations.amplitude_images is not None:
            left, bright, right = near(observations.amplitude_images[part][:, skip].double())
            around = (right + left) / 2
            for apart in ((right - left).abs(), (bright - around).abs()):
                inside &= apart < SAME_BRIGHTNESS * around
        else:
            bright = inverse_square(near(predicted)[1])
        frame, row, column = torch.nonzero(inside).unbind(1)
        place = row * inside.shape[2] + column
        parts.append((difference[inside], bright[inside], frame + part.start, place))
    return tuple(torch.cat(part).numpy() for part in zip(*parts, strict=True))


def _by_neighbours(
    difference: np.ndarray, brightness: np.ndarray, frame: np.ndarray, num_frames: int
) -> PixelNoise:
    """Fit the curve and the frames' factors in turn; the arguments are as above."""
    ends = np.searchsorted(frame, np.arange(1, num_frames))
    groups = brightness_bins(brightness, _LEAST_PER_KNOT)
    middles = np.array([max(np.median(brightness[own]), TINY) for own in groups])
    noise = PixelNoise(knots=np.zeros(1), sigma=np.ones(1), factor=np.ones(num_frames))
    for _ in range(3):
        variances = []
        for members in groups:
            values = difference[members] / noise.factor[frame[members]]
            values = values - np.median(values)
            square = np.mean(values[no_gross_error(values)] ** 2) / SECOND_DIFFERENCE
            variances.append(max(square, _LEAST_SIGMA**2))
        counts = np.array([len(members) for members in groups])
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
    estimate it. It is 0 unless it exceeds two standard errors.
    """
    weight = np.where(no_gross_error(difference / expected), expected**-2, 0.0)

    def pairs(values: np.ndarray) -> np.ndarray:
        """Return the sum of the products of all pairs at each place, in both orders."""
        return np.bincount(place, values) ** 2 - np.bincount(place, values**2)

    weighted = difference * weight
    total, products = float(pairs(weight).sum()), float(pairs(weighted).sum())
    if total <= 0 or products < 2 * float(np.sqrt(2 * pairs(weighted**2).sum())):
        return 0.0
    return products / total / SECOND_DIFFERENCE


def _with_repeats(observations: Observations, noise: PixelNoise) -> PixelNoise:
    """Return the noise with what the variation over repeated frames says, over that of the model.

    Two frames of one pose, target and exposure are repeats: they give one degree of freedom in each
    of thousands of pixels.
    """
    together = [members for members in repeats_of(observations.recording) if len(members) > 1]
    found = [_repeats(observations, noise, members) for members in together]
    groups = [group for group in found if group is not None]
    if not groups:
        return noise
    frames = [group[0] for group in groups]

    def ratio(kept: float, left_out: int | None = None) -> float:
        """Return the root of measured over modelled mean square, if frames keep this share."""
        used = [group for number, group in enumerate(groups) if number != left_out]
        model = sum(own[2] * (1 - mean_correlation(kept, own[0])) for own in used)
        return max(float(np.sqrt(sum(own[1] for own in used) / model)), LEAST_RATIO)

    weakest, kept, strongest = _kept_share([apart for count, *_, apart in groups if count > 2])
    # Poses show other brightnesses, at which the model of the noise may be off more or less.
    count = len(groups)
    without = [ratio(kept, number) for number in range(count)] if count > 1 else [1.0]
    spread = 2 * np.sqrt((count - 1) * np.var(without)) / ratio(kept)
    least = ratio(weakest)
    ratios = least, max(least, 1.0), np.inf
    if strongest is not None:
        ratios = least, ratio(kept), ratio(strongest)
    return replace(noise, repeats=sum(frames), ratios=ratios, spread=min(spread, 0.5))


def _repeats(
    observations: Observations, noise: PixelNoise, members: np.ndarray
) -> tuple[int, float, float, np.ndarray] | None:
    """Return weighted sums over the frames of one pose; None where no pixel is in all of them.

    Returns:
        Number of frames; sum of squared deviations from the mean frame, over the degrees of freedom
        and times the frames; what the noise model expects of it; and of frames one and two apart
        half the squared differences in each tile, shape (2, T).
    """
    images = observations.distance_images[members].double()
    use = (images > 0).all(0) & observations.on_target[members].all(0)
    if not use.any():
        return None
    values = images[:, use].numpy()
    brightness = inverse_square(images[:, use].mean(0)).numpy()
    if observations.amplitude_images is not None:
        brightness = observations.amplitude_images[members].double()[:, use].mean(0).numpy()
    expected = noise.at_numpy(brightness, members[0])
    # Pixels with a gross error in any frame do not count.
    around = values - images[:, use].median(1, keepdim=True).values.numpy()
    ratio = (around - around.mean(0)) / expected
    kept = no_gross_error(ratio.ravel()).reshape(ratio.shape).all(0)
    if not kept.any():
        return None
    values, expected, tile = values[:, kept], expected[kept], tiles_of(use.numpy())[kept]
    around = values - values.mean(1, keepdims=True)
    around = around - around.mean(0)
    weight, frames = gap_weight(torch.from_numpy(expected)).numpy(), len(members)
    apart = [
        np.bincount(tile, weight * ((around[lag:] - around[:-lag]) ** 2).mean(0) / 2)
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
        apart: Of each pose of three frames and more, as `_repeats` returns it.
    """
    value, error = frame_correlation(np.concatenate(apart, axis=1)) if apart else (np.nan, 0.0)
    if np.isnan(value):
        return 0.0, 0.0, None
    most_kept = 0.9  # Beyond it frames hardly differ, and nothing can be said.
    kept, reach = float(np.clip(value, 0.0, most_kept)), 2 * error
    least = max(min(value - reach, kept), 0.0)
    return least, kept if kept > reach else 0.0, min(kept + reach, most_kept)
