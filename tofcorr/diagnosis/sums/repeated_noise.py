r"""The noise in frames that were repeated, where a filter over time may make them alike.

Repeats differ by noise alone. A filter that keeps the share r of the frame before leaves noise of
variance s^2 with a correlation of r^k over k frames, so that frames k apart differ by

.. math:: \gamma_k = \tfrac12 E (x_t - x_{t+k})^2 = s^2 (1 - r^k), \qquad
          \gamma_2 / \gamma_1 = 1 + r .

Three frames of a pose give r, and with it s^2. Two do not.
"""

from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from tofcorr.diagnosis.sums.observations import Observations
from tofcorr.diagnosis.sums.pixel_noise import NO_REPEATS, PixelNoise, RepeatedNoise, gap_weight
from tofcorr.diagnosis.sums.repeats import same_exposure
from tofcorr.diagnosis.sums.robust_weights import no_gross_error
from tofcorr.observables.frame_filter import frame_correlation, mean_correlation, tiles_of

# Frames of one pose, target and exposure count as repeats from this number on. Two give one degree
# of freedom in each of thousands of pixels.
_LEAST_REPEATS = 2
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
        if len(members) >= _LEAST_REPEATS
        and (group := _group(observations, noise, members)) is not None
    ]
    if not groups:
        return NO_REPEATS
    least, kept, most = _kept(groups)
    return RepeatedNoise(
        frames=sum(group.frames for group in groups),
        least=_ratio(groups, least),
        ratio=np.inf if most is None else _ratio(groups, kept),
        most=np.inf if most is None else _ratio(groups, most),
        error=_error(groups, kept),
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


def _kept(groups: list[_Group]) -> tuple[float, float, float | None]:
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


def _error(groups: list[_Group], kept: float) -> float:
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
