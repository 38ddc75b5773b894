r"""How much of its noise a pixel shares with its neighbours, as where a camera filters its images.

With n the noise over its standard deviation, the autocovariance C(k) = mean n(p) n(p + k) is
estimated from what differs between repeated frames of one exposure: there nothing but noise
differs. Without repeats, or with too few, it is that of the residual, less what is the same in
every image, less the plateau that it has beyond the reach of any filter: structure reaches farther
than a filter. Pixels beside an edge of brightness are not used then, because some errors belong to
edges, unless hardly any others are left.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import torch
from torch import Tensor

from tofcorr.data.recording import repeats_of
from tofcorr.diagnosis.sums.noise import FLOOR_ERROR, LEAST_RATIO
from tofcorr.diagnosis.sums.observations import (
    Observations,
    small_tiles,
)
from tofcorr.estimation.noise import SAME_BRIGHTNESS, SECOND_DIFFERENCE, SPACING
from tofcorr.pixels.sample import thinned

MOST_PIXELS = 8_000_000
"""Pixels of whole images that are looked at, or simulated: of larger recordings some frames alone.
Chosen to bound the memory to about half a gigabyte."""


class Lags:
    """Autocovariance over lags up to `farthest` rows and columns, frame by frame.

    Args:
        values: Images of mean zero, shape (F, H, W).
        used: Which pixels count, bool, shape (F, H, W).

    Attributes:
        products: Sums of the products of two pixels at each lag from -reach to reach, shape
            (F, 2 rows + 1, 2 columns + 1).
        counts: Number of these pairs.

    Class attributes:
        filter_reach: Filters reach this far, pixels: farther pixels share no noise. Chosen: three
            standard deviations of a filter of 2.7 pixels; vendors' filters have 3 to 7 taps.
        farthest: The plateau is the mean over the lags from there to this one. Chosen: five lags.
        least_left: Least share of the variance of second differences that correlation may leave.
            Chosen: bounds the correction to 2.
        structure: Correlation beyond a filter's reach is structure if it varies by more than this
            share of that of neighbours. Set on openings 1 to 4 of `benchmarks.renewed`: stripes 0.3
            to 0.7, filters below 0.1.
        significant: Correlation counts from this many standard errors on, and is structure where
            both halves of the frames agree in it by as many. The usual convention.
    """

    filter_reach: ClassVar = 8
    farthest: ClassVar = 12
    least_left: ClassVar = 0.25
    structure: ClassVar = 0.25
    significant: ClassVar = 3

    def __init__(self, values: np.ndarray, used: np.ndarray) -> None:
        shape = values.shape[1:]
        # Multiples of 16: prime factors above 100 take several times as long.
        size = tuple(-(-(length + self.farthest) // 16) * 16 for length in shape)
        self.reach = tuple(min(self.farthest, length - 1) for length in shape)
        rows, columns = self._lags = [np.arange(-reach, reach + 1) for reach in self.reach]
        self.products, self.counts = (
            np.fft.irfft2(np.abs(np.fft.rfft2(images, size)) ** 2, size)[:, rows[:, None], columns]
            for images in (values * used, used.astype(float))
        )
        self.counts = self.counts.round()

    def at(self, row: int, column: int) -> float:
        """Return the autocovariance at one lag; 0 where no pair has it."""
        if abs(row) > self.reach[0] or abs(column) > self.reach[1]:
            return 0.0
        place = np.s_[:, row + self.reach[0], column + self.reach[1]]
        return float(self.products[place].sum() / max(self.counts[place].sum(), 1.0))

    def plateau(self, form: str) -> float:
        """Return what pixels farther apart than a filter reaches still share, at least 0."""
        far = range(self.filter_reach, self.farthest + 1)
        along = {
            "rows": float(np.mean([self.at(0, k) for k in far])),
            "columns": float(np.mean([self.at(k, 0) for k in far])),
        }
        return max(0.0, along.get(form, max(along.values())))

    def level(self) -> float:
        """Return the noise over what second differences between neighbours see of it."""
        plateau = self.plateau("rows")
        own, once, twice = (self.at(0, k * SPACING) - plateau for k in range(3))
        seen = 1 - (2 * once - twice / 2) / max(own, LEAST_RATIO) / SECOND_DIFFERENCE
        return float(np.clip(seen, self.least_left, 1.0) ** -0.5)

    def reaches_far(self, share: float) -> bool:
        """Return whether pixels farther apart than a filter reaches vary together, or oppositely.

        Narrow stripes do this, and neighbours share them as they would share filtered noise. Only
        what the first and the second half of the frames agree in counts.

        Args:
            share: What neighbours share, over the variance of a pixel.
        """
        rows, columns = map(np.abs, self._lags)
        far, half = np.maximum(rows[:, None], columns) >= self.filter_reach, len(self.counts) // 2
        pairs, products = (
            np.stack([sums[:half].sum(0)[far], sums[half:].sum(0)[far]])
            for sums in (self.counts, self.products)
        )
        weight = pairs.min(0) / max(float(pairs.min(0).sum()), 1.0)
        both = products / np.maximum(pairs, 1.0)
        both -= (both @ weight)[:, None]
        agreed = both[0] * both[1]
        square = float(agreed @ weight)
        error = float(np.linalg.norm((agreed - square) * weight))
        # Of few pixels every lag is uncertain, and halves agree by chance.
        least = (self.structure * share * self.at(0, 0)) ** 2
        return square > max(self.significant * error, least)

    def mean_in_tiles(self, cells: np.ndarray, plateau: float) -> tuple[float, float]:
        """Return the mean autocovariance over pairs of a tile, and its standard error.

        The error comes from the differences between frames: infinite of fewer than two with pixels.

        Args:
            cells: Tile of each pixel of a frame, shape (H, W); -1: not used.
            plateau: Subtracted from every lag within reach.
        """
        weight = self.counts[:, self.reach[0], self.reach[1]]
        if (weight > 0).sum() < 2:
            return 0.0, float("inf")
        height, width = cells.shape
        padded, near = np.pad(cells, self.farthest, constant_values=-1), self.farthest
        pairs = np.zeros(self.counts.shape[1:])
        for i, row in enumerate(self._lags[0]):
            for j, column in enumerate(self._lags[1]):
                if (row, column) != (0, 0) and max(abs(row), abs(column)) <= self.filter_reach:
                    other = padded[near + row :, near + column :][:height, :width]
                    pairs[i, j] = ((cells == other) & (cells >= 0)).sum()
        sizes = np.bincount(cells[cells >= 0])
        excess = (self.products - plateau * self.counts) / np.maximum(self.counts.sum(0), 1.0)
        own = (pairs * excess).sum((1, 2)) / max(float((sizes * (sizes - 1)).sum()), 1.0)
        mean = float(own.sum())
        return mean, float(np.linalg.norm(own - mean * weight / weight.sum()))


@dataclass(frozen=True)
class SharedNoise:
    """What pixels share of their noise.

    Attributes:
        share: For each form of tiles (`small_tiles`), the mean product of the noise of two pixels
            of a tile over its variance; 0 where it is not significant.
        error: Standard error of each.
        level: Noise of a pixel over what differences between neighbours see of it, at least 1.
        from_repeats: Whether repeated frames say so.
        striped: Whether it is structure that no filter makes, so that the level is 1.
        whole: Variance of what was used over that of the noise with this level.
    """

    share: dict[str, float]
    error: dict[str, float]
    level: float
    from_repeats: bool
    striped: bool
    whole: float

    @property
    def precise(self) -> bool:
        """Whether a filter that is there would be found: filters leave shares of 0.1 to 0.6."""
        return max(self.error.values()) <= FLOOR_ERROR


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
    frames = _frames(observations)
    used = _image(observations, trust > 0, frames)
    precision = _image(observations, 1 / sigma, frames)
    images = _image(observations, residual / sigma, frames)
    # Tile of each pixel of the frame with the most pixels.
    fullest = torch.bincount(observations.frame).argmax(0, keepdim=True).numpy()
    tiles = {
        form: _image(observations, own, fullest, -1)[0]
        for form, own in small_tiles(observations).items()
    }
    groups = repeats_of(observations.recording)
    together = [np.flatnonzero(np.isin(frames, group)) for group in groups]
    repeats = [group for group in together if len(group) > 1]
    # A standard error needs four repeats beyond the first frame of each pose.
    if sum(len(group) - 1 for group in repeats) >= 4:
        pairs = [_around_mean(images[group], used[group]) for group in repeats]
        values, same = (np.concatenate(part) for part in zip(*pairs, strict=True))
        found = _found(values, same, tiles, from_repeats=True)
        if found.precise or found.striped:
            return found
    step = max(1, len(images) // 60)  # About 60 frames say enough.
    away = used & ~_edges(observations, frames)
    found = _found(*_apart_from_pattern(images, precision, away, step), tiles, from_repeats=False)
    # A few pixels away from edges are those that masks and edges leave by chance.
    if found.precise and 10 * away.sum() >= used.sum():
        return found
    every = _found(*_apart_from_pattern(images, precision, used, step), tiles, from_repeats=False)
    # With twice the variance of the noise, most of what neighbours share is structure.
    return every if every.whole < 2 else found


def _found(
    values: np.ndarray, used: np.ndarray, tiles: Mapping[str, np.ndarray], *, from_repeats: bool
) -> SharedNoise:
    """Estimate what pixels share from images (F, H, W), for tiles (H, W) of every form.

    The noise is known to `FLOOR_ERROR`. Without repeats a mean correlation in a tile below that
    does not count, even if it is significant: it may be structure. And as much of the noise at
    least is each pixel's own.
    """
    # Clipped at six standard deviations, as in the noise estimate.
    lags, share, error = Lags(np.clip(values, -6, 6), used), {}, {}
    # Noise over that assumed: less where a filter over time makes repeats alike.
    whole = max(lags.at(0, 0) - (0.0 if from_repeats else lags.plateau("squares")), LEAST_RATIO)
    for form, cells in tiles.items():
        plateau = 0.0 if from_repeats else lags.plateau(form)
        value, own = (x / whole for x in lags.mean_in_tiles(cells, plateau))
        least = max(lags.significant * own, 0.0 if from_repeats else FLOOR_ERROR)
        share[form] = min(value, 1 - FLOOR_ERROR) if value > least else 0.0
        error[form] = own
    most = max(share.values())
    striped = most > 0 and lags.reaches_far(most)
    level = lags.level() if most > 0 and not striped else 1.0
    return SharedNoise(share, error, level, from_repeats, striped, whole / level**2)


def _frames(observations: Observations) -> np.ndarray:
    """Return the frames that are looked at: all that have pixels, or those of some poses.

    They are 20 at least, so that the mean of the others shows what all have in common.
    """
    seen = observations.frame.unique().numpy()
    most = max(MOST_PIXELS // observations.on_target[0].numel(), 20)
    unit = observations.unit.numpy()[seen]
    poses = np.unique(unit)
    return seen[np.isin(unit, thinned(poses, max(len(poses) * most // len(seen), 1)))]


def _image(
    observations: Observations, values: Tensor, frames: np.ndarray, fill: float = 0
) -> np.ndarray:
    """Return values (M,) as images (F, H, W) of some frames; `fill` where there are none."""
    size, frame = observations.on_target.shape[1:], torch.from_numpy(frames)
    own = torch.isin(observations.frame, frame)
    images = torch.full((len(frames), size.numel()), fill, dtype=values.dtype)
    row = torch.searchsorted(frame, observations.frame[own])
    images[row, observations.pixel[own]] = values[own]
    return images.reshape(-1, *size).numpy()


def _around_mean(images: np.ndarray, used: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return what differs between repeats, with the variance of one frame's noise."""
    everywhere = used.all(0)
    around = images - images.mean(0)
    around = around - around[:, everywhere].mean(1)[:, None, None] if everywhere.any() else around
    freedom = (len(images) - 1) / len(images)
    return around / freedom**0.5, np.broadcast_to(everywhere, images.shape)


def _apart_from_pattern(
    images: np.ndarray, precision: np.ndarray, used: np.ndarray, step: int
) -> tuple[np.ndarray, np.ndarray]:
    """Return images less what all have in common, and less the offset and tilts of each.

    What they have in common is so in metres. In units of the noise it is smaller where an image is
    darker. A pose tilts a whole image; pixels far apart would seem to share that.

    Args:
        images: Residuals over the standard deviation of the noise, shape (F, H, W).
        precision: One over that standard deviation, shape (F, H, W), 1 / m.
        used: Which pixels count, shape (F, H, W).
        step: Of the images that are returned.
    """
    weight, part = used * precision, slice(None, None, step)
    # The mean of all other images has nothing of an image's own noise.
    others = (weight * images).sum(0) - (weight * images)[part]
    certain = (weight**2).sum(0) - weight[part] ** 2
    own = images[part] - precision[part] * others / np.where(certain > 0, certain, 1.0)
    use = used[part] & (used.sum(0) > 1)
    row, column = (np.linspace(-1, 1, length) for length in images.shape[1:])
    basis = np.stack(np.broadcast_arrays(1.0, row[:, None], column)).reshape(3, -1)
    flat, inside = own.reshape(len(own), -1), use.reshape(len(use), -1).astype(float)
    inner = np.einsum("fp,ip,jp->fij", inside, basis, basis, optimize=True)
    right = ((flat * inside) @ basis.T)[..., None]
    tilts = (np.linalg.pinv(inner, hermitian=True) @ right)[..., 0]
    return own - (tilts @ basis).reshape(own.shape), use


def _edges(observations: Observations, frames: np.ndarray) -> np.ndarray:
    """Return where direct neighbours differ in brightness in some frames, (F, H, W)."""
    edges = np.zeros((len(frames), *observations.distance_images.shape[1:]), dtype=bool)
    if observations.amplitude_images is None:
        return edges
    amplitude = observations.amplitude_images.numpy()[frames]
    for one, other in ((np.s_[:, :-1], np.s_[:, 1:]), (np.s_[:, :, :-1], np.s_[:, :, 1:])):
        low = np.minimum(amplitude[one], amplitude[other])
        odd = np.abs(amplitude[other] - amplitude[one]) > SAME_BRIGHTNESS * low
        edges[one] |= odd
        edges[other] |= odd
    return edges


def whole_images(observations: Observations) -> Observations:
    """Return all pixels of some evenly spread frames; chosen pixels have no near neighbours.

    Of some 400 000 pixels, in eight frames at least, correlations are known to a per cent.
    """
    usable = observations.usable.flatten(1)
    counts = usable.sum(1)
    seen = counts.nonzero()[:, 0]
    most = max(int(400_000 / counts[seen].double().mean()), 8)
    frames = torch.from_numpy(thinned(seen.numpy(), most))
    number, pixel = usable[frames].nonzero(as_tuple=True)
    return observations.choosing(frames[number], pixel)
