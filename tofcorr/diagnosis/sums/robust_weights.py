"""Robust weights: gross errors of single pixels get less weight, structures keep theirs."""

import numpy as np
import torch
from torch import Tensor

from tofcorr.diagnosis.sums.observations import Observations
from tofcorr.diagnosis.sums.pixel_noise import brightness_of

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
