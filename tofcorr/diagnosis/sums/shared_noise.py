r"""How much of its noise a pixel shares with its neighbours, as where a camera filters its images.

With n the noise over its standard deviation, the autocovariance C(k) = mean n(p) n(p + k) is
estimated from what differs between repeated frames of one exposure: there nothing but noise
differs. Without repeats it is that of the residual, less what is the same in every image, less the
plateau that it has beyond the reach of any filter: structure reaches farther than a filter. Pixels
beside an edge of brightness are not used then, because some errors belong to edges.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from tofcorr.diagnosis.sums.observations import Observations
from tofcorr.diagnosis.sums.repeats import same_exposure
from tofcorr.diagnosis.sums.small_tiles import small_tiles

# Filters reach this far, pixels: farther pixels share no noise. Chosen: three standard deviations
# of a filter of 2.7 pixels; vendors' filters have 3 to 7 taps.
_REACH = 8
# The plateau is the mean over the lags from `_REACH` to this one, pixels. Chosen: five lags.
_PLATEAU = 12
# Correlation counts from this many standard errors on. The usual convention.
_SIGNIFICANT = 3.0
# Without repeats a smaller mean correlation in a tile does not count, even if it is significant: it
# may be structure. Chosen: filters leave 0.1 to 0.6.
_LEAST_SHARE = 0.05
# Lag of the differences between neighbours, pixels. The same as in `noise_estimate`.
_SPACING = 3
# Variance of x - (left + right) / 2 for independent noise of variance one: 1 + 1/4 + 1/4.
_SECOND_DIFFERENCE = 1.5
# Least share of that variance that correlation may leave. Chosen: bounds the correction to 2.
_LEAST_LEFT = 0.25
# Amplitudes of direct neighbours that differ by more than this share make an edge. Chosen, as in
# the noise estimate.
_SAME_BRIGHTNESS = 0.25
# Residuals are clipped at this many standard deviations. Chosen, as in the noise estimate.
_CLIP = 6.0
# Number of frames that correlations are estimated from, at most, evenly spread. Chosen to bound the
# time.
_MOST_FRAMES = 60


@dataclass(frozen=True, kw_only=True)
class SharedNoise:
    """What pixels share of their noise.

    Attributes:
        share: For each form of tiles (`small_tiles`), the mean product of the noise of two pixels
            of a tile over its variance; 0 where it is not significant.
        error: Standard error of each.
        level: Noise of a pixel over what differences between neighbours see of it, at least 1.
        from_repeats: Whether repeated frames say so.
    """

    share: dict[str, float]
    error: dict[str, float]
    level: float
    from_repeats: bool


def shared_noise(
    observations: Observations, residual: Tensor, sigma: Tensor, trust: Tensor
) -> SharedNoise:
    """Estimate what pixels share of their noise.

    Args:
        observations: The M pixels.
        residual: Of the base fit, shape (M,), metres.
        sigma: Noise of the pixels, shape (M,), metres.
        trust: Robust weights, shape (M,); pixels without weight are not used.
    """
    noise = (residual / sigma).clamp(-_CLIP, _CLIP)
    images, used = _images(observations, noise, trust > 0)
    repeats = [group for group in same_exposure(observations) if len(group) > 1]
    if repeats:
        pairs = [_around_mean(images[group], used[group]) for group in repeats]
    else:
        step = max(1, len(images) // _MOST_FRAMES)
        used = used & ~_edges(observations)
        pairs = [_apart_from_pattern(images, used, step)]
    lags = _Lags(np.concatenate([p[0] for p in pairs]), np.concatenate([p[1] for p in pairs]))
    share, error = {}, {}
    for form, cells in small_tiles(observations).items():
        plateau = 0.0 if repeats else lags.plateau(form)
        value, own = lags.mean_in_tiles(_cell_image(observations, cells), plateau)
        least = max(_SIGNIFICANT * own, 0.0 if repeats else _LEAST_SHARE)
        share[form] = value if value > least else 0.0
        error[form] = own
    level = lags.level() if max(share.values()) > 0 else 1.0
    # Repeats that a filter over time makes alike vary less than the noise, in all lags.
    whole = lags.at(0, 0) if repeats else level**2
    return SharedNoise(
        share={form: value / max(whole, 1e-9) for form, value in share.items()},
        error={form: value / max(whole, 1e-9) for form, value in error.items()},
        level=level,
        from_repeats=bool(repeats),
    )


class _Lags:
    """Autocovariance over lags up to `_PLATEAU` rows and columns, frame by frame."""

    def __init__(self, values: np.ndarray, used: np.ndarray) -> None:
        height, width = values.shape[1:]
        size = (height + _PLATEAU, width + _PLATEAU)
        spectrum = np.fft.rfft2(values * used, size)
        mask = np.fft.rfft2(used.astype(float), size)
        self.reach = (min(_PLATEAU, height - 1), min(_PLATEAU, width - 1))
        self.products = self._near(np.fft.irfft2(np.abs(spectrum) ** 2, size))
        self.counts = self._near(np.fft.irfft2(np.abs(mask) ** 2, size).round())

    def _near(self, wrapped: np.ndarray) -> np.ndarray:
        """Return lags from -reach to reach, (F, 2 rows + 1, 2 columns + 1)."""
        rows, columns = self.reach
        order_r, order_c = np.arange(-rows, rows + 1), np.arange(-columns, columns + 1)
        return wrapped[:, order_r][:, :, order_c]

    def at(self, row: int, column: int) -> float:
        """Return the autocovariance at one lag; 0 where no pair has it."""
        place = (slice(None), row + self.reach[0], column + self.reach[1])
        if abs(row) > self.reach[0] or abs(column) > self.reach[1]:
            return 0.0
        return float(self.products[place].sum() / max(self.counts[place].sum(), 1.0))

    def plateau(self, form: str) -> float:
        """Return what pixels farther apart than a filter reaches still share, at least 0."""
        far = range(_REACH, _PLATEAU + 1)
        along = {
            "rows": float(np.mean([self.at(0, k) for k in far])),
            "columns": float(np.mean([self.at(k, 0) for k in far])),
        }
        return max(0.0, along.get(form, max(along.values())))

    def level(self) -> float:
        """Return the noise over what second differences between neighbours see of it."""
        plateau = self.plateau("rows")
        own = max(self.at(0, 0) - plateau, 1e-9)
        near = [(self.at(0, k * _SPACING) - plateau) / own for k in (1, 2)]
        seen = 1 - (2 * near[0] - near[1] / 2) / _SECOND_DIFFERENCE
        return float(np.clip(seen, _LEAST_LEFT, 1.0) ** -0.5)

    def mean_in_tiles(self, cells: np.ndarray, plateau: float) -> tuple[float, float]:
        """Return the mean autocovariance over pairs of a tile, and its standard error.

        Args:
            cells: Tile of each pixel of a frame, shape (H, W); -1: not used.
            plateau: Subtracted from every lag within reach.
        """
        sizes = np.bincount(cells[cells >= 0])
        total = float((sizes * (sizes - 1)).sum())
        counts = self.counts.sum(0)
        own = np.zeros(len(self.products))
        for row, column, pairs in _pairs(cells, self.reach):
            place = (slice(None), row + self.reach[0], column + self.reach[1])
            here = max(float(counts[place[1:]]), 1.0)
            excess = self.products[place] - plateau * self.counts[place]
            own += 2 * pairs * excess / here
        own /= max(total, 1.0)
        weight = self.counts[:, self.reach[0], self.reach[1]]
        weight = weight / max(float(weight.sum()), 1.0)
        mean = float(own.sum())
        return mean, float(np.sqrt(np.sum((own - mean * weight) ** 2)))


def _pairs(cells: np.ndarray, reach: tuple[int, int]) -> Sequence[tuple[int, int, int]]:
    """Return lags within a filter's reach, and how many pairs of pixels of one tile have them."""
    found = []
    rows, columns = min(_REACH, reach[0]), min(_REACH, reach[1])
    for row in range(rows + 1):
        for column in range(-columns, columns + 1):
            if row == 0 and column <= 0:
                continue
            first = cells[: cells.shape[0] - row]
            second = cells[row:]
            one = first[:, max(0, -column) : cells.shape[1] - max(0, column)]
            other = second[:, max(0, column) : cells.shape[1] - max(0, -column)]
            count = int(((one == other) & (one >= 0)).sum())
            if count:
                found.append((row, column, count))
    return found


def _images(
    observations: Observations, values: Tensor, use: Tensor
) -> tuple[np.ndarray, np.ndarray]:
    """Return values as images (F, H, W), and where there are any."""
    camera = observations.recording.camera
    shape = (observations.num_frames, camera.height * camera.width)
    images, used = torch.zeros(shape, dtype=torch.float64), torch.zeros(shape, dtype=torch.bool)
    images[observations.frame, observations.pixel] = values
    used[observations.frame, observations.pixel] = use
    size = (-1, camera.height, camera.width)
    return images.reshape(size).numpy(), used.reshape(size).numpy()


def _cell_image(observations: Observations, cells: Tensor) -> np.ndarray:
    """Return the tile of each pixel of the frame with the most pixels, (H, W); -1: not used."""
    camera = observations.recording.camera
    frame = int(torch.bincount(observations.frame).argmax())
    own = observations.frame == frame
    image = torch.full((camera.height * camera.width,), -1)
    image[observations.pixel[own]] = cells[own]
    return image.reshape(camera.height, camera.width).numpy()


def _around_mean(images: np.ndarray, used: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return what differs between repeats, with the variance of one frame's noise."""
    everywhere = used.all(0)
    around = images - images.mean(0)
    around = around - around[:, everywhere].mean(1)[:, None, None] if everywhere.any() else around
    freedom = (len(images) - 1) / len(images)
    return around / freedom**0.5, np.broadcast_to(everywhere, images.shape)


def _apart_from_pattern(
    images: np.ndarray, used: np.ndarray, step: int
) -> tuple[np.ndarray, np.ndarray]:
    """Return images less what all have in common, and less the mean of each."""
    count = used.sum(0)
    total = (images * used).sum(0)
    # The mean of all other images has nothing of an image's own noise.
    others = (total - images[::step] * used[::step]) / np.maximum(count - used[::step], 1)
    own, use = images[::step] - others, used[::step] & (count > 1)
    mean = (own * use).sum((1, 2)) / np.maximum(use.sum((1, 2)), 1)
    return own - mean[:, None, None], use


def _edges(observations: Observations) -> np.ndarray:
    """Return where direct neighbours differ in brightness, (F, H, W)."""
    edges = np.zeros(tuple(observations.distance_images.shape), dtype=bool)
    if observations.amplitude_images is None:
        return edges
    amplitude = observations.amplitude_images.numpy()
    for axis in (1, 2):
        apart = np.abs(np.diff(amplitude, axis=axis))
        low = np.minimum(np.delete(amplitude, -1, axis), np.delete(amplitude, 0, axis))
        odd = apart > _SAME_BRIGHTNESS * low
        head, tail = [slice(None)] * 3, [slice(None)] * 3
        head[axis], tail[axis] = slice(None, -1), slice(1, None)
        edges[tuple(head)] |= odd
        edges[tuple(tail)] |= odd
    return edges
