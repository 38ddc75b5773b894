r"""How much of its noise a pixel shares with its neighbours, as where a camera filters its images.

With n the noise over its standard deviation, the autocovariance C(k) = mean n(p) n(p + k) is
estimated from what differs between repeated frames of one exposure: there nothing but noise
differs. Without repeats, or with too few, it is that of the residual, less what is the same in
every image, less the plateau that it has beyond the reach of any filter: structure reaches farther
than a filter. Pixels beside an edge of brightness are not used then, because some errors belong to
edges, unless hardly any others are left.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from itertools import product
from typing import ClassVar

import numpy as np
import torch
from torch import Tensor

from tofcorr.diagnosis.sums.noise import Neighbours, PixelNoise, brightness_of, robust_weights
from tofcorr.diagnosis.sums.observations import Observations, same_exposure, small_tiles
from tofcorr.estimation.noise import SAME_BRIGHTNESS, SECOND_DIFFERENCE, SPACING

# Correlation counts from this many standard errors on, and is structure where both halves of the
# frames agree in it by as many. The usual convention.
_SIGNIFICANT = 3.0
# Without repeats a smaller mean correlation in a tile does not count, even if it is significant: it
# may be structure. The largest standard error at which filters are found; otherwise more pixels are
# used: of single frames, and at last beside edges. And the largest share: some of the noise is each
# pixel's own. Chosen: filters leave 0.1 to 0.6.
_LEAST_SHARE, _PRECISE, _MOST_SHARE = 0.05, 0.06, 0.95
# Least variance of the noise over that assumed, and what is added to the equations of an image's
# offset and tilts, pixels. Chosen: keeps both solvable without noise, or of few pixels.
_TINY = 1e-6
# Beside edges pixels are used if their residuals vary less than this, over the variance of the
# noise: with more, most of what neighbours share is structure. Pixels away from edges speak for all
# if they are at least such a share: a few are those that masks and edges leave by chance. Chosen.
_MOST_WHOLE, _LEAST_AWAY = 2.0, 0.1
# Residuals are clipped at this many standard deviations. Chosen, as in the noise estimate.
_CLIP = 6.0
# Number of frames that correlations are estimated from, at most, evenly spread; and pixels of the
# images that are looked at: of more, only some poses are. Chosen to bound the time, and the memory
# to about half a gigabyte. But at least so many frames, so that the mean of the others shows what
# all have in common.
_MOST_FRAMES, _MOST_PIXELS, _LEAST_FRAMES = 60, 8_000_000, 20
# Where pixels were chosen, about how many pixels of whole images are looked at, in at least so many
# frames. Chosen: correlations of neighbours are then known to a per cent.
_WHOLE_PIXELS, _LEAST_WHOLE_FRAMES = 400_000, 8


class Lags:
    """Autocovariance over lags up to `farthest` rows and columns, frame by frame.

    Args:
        values: Images of mean zero, shape (F, H, W).
        used: Which pixels count, bool, shape (F, H, W).

    Class attributes:
        filter_reach: Filters reach this far, pixels: farther pixels share no noise. Chosen: three
            standard deviations of a filter of 2.7 pixels; vendors' filters have 3 to 7 taps.
        farthest: The plateau is the mean over the lags from there to this one. Chosen: five lags.
        least_left: Least share of the variance of second differences that correlation may leave.
            Chosen: bounds the correction to 2.
        structure: Correlation beyond a filter's reach is structure if it varies by more than this
            share of that of neighbours. Set on openings 1 to 4 of `benchmarks.renewed`: stripes 0.3
            to 0.7, filters below 0.1.
    """

    filter_reach: ClassVar = 8
    farthest: ClassVar = 12
    least_left: ClassVar = 0.25
    structure: ClassVar = 0.25

    def __init__(self, values: np.ndarray, used: np.ndarray) -> None:
        height, width = values.shape[1:]
        # Multiples of 16: prime factors above 100 take several times as long.
        size = tuple(-(-(length + self.farthest) // 16) * 16 for length in (height, width))
        spectrum = np.fft.rfft2(values * used, size)
        mask = np.fft.rfft2(used.astype(float), size)
        self.reach = (min(self.farthest, height - 1), min(self.farthest, width - 1))
        # Lags from -reach to reach, (F, 2 rows + 1, 2 columns + 1).
        rows, columns = (np.arange(-reach, reach + 1) for reach in self.reach)
        near = np.s_[:, rows[:, None], columns]
        self.products = np.fft.irfft2(np.abs(spectrum) ** 2, size)[near]
        self.counts = np.fft.irfft2(np.abs(mask) ** 2, size).round()[near]

    def at(self, row: int, column: int) -> float:
        """Return the autocovariance at one lag; 0 where no pair has it."""
        place = (slice(None), row + self.reach[0], column + self.reach[1])
        if abs(row) > self.reach[0] or abs(column) > self.reach[1]:
            return 0.0
        return float(self.products[place].sum() / max(self.counts[place].sum(), 1.0))

    def plateau(self, form: str) -> float:
        """Return what pixels farther apart than a filter reaches still share, at least 0."""
        far = range(self.filter_reach, self.farthest + 1)
        rows, columns = [self.at(0, k) for k in far], [self.at(k, 0) for k in far]
        along = {"rows": float(np.mean(rows)), "columns": float(np.mean(columns))}
        return max(0.0, along.get(form, max(along.values())))

    def level(self) -> float:
        """Return the noise over what second differences between neighbours see of it."""
        plateau = self.plateau("rows")
        own = max(self.at(0, 0) - plateau, _TINY)
        near = [(self.at(0, k * SPACING) - plateau) / own for k in (1, 2)]
        seen = 1 - (2 * near[0] - near[1] / 2) / SECOND_DIFFERENCE
        return float(np.clip(seen, self.least_left, 1.0) ** -0.5)

    def reaches_far(self, share: float) -> bool:
        """Return whether pixels farther apart than a filter reaches vary together, or oppositely.

        Narrow stripes do this, and neighbours share them as they would share filtered noise. Only
        what the first and the second half of the frames agree in counts.

        Args:
            share: What neighbours share, over the variance of a pixel.
        """
        rows, columns = (np.abs(np.arange(-reach, reach + 1)) for reach in self.reach)
        far = np.maximum(rows[:, None], columns) >= self.filter_reach
        half = len(self.counts) // 2
        halves = slice(half), slice(half, None)
        pairs = np.stack([self.counts[half].sum(0)[far] for half in halves])
        products = np.stack([self.products[half].sum(0)[far] for half in halves])
        weight = pairs.min(0) / max(float(pairs.min(0).sum()), 1.0)
        both = products / np.maximum(pairs, 1.0)
        both -= (both @ weight)[:, None]
        agreed = both[0] * both[1]
        square = float(agreed @ weight)
        error = float(np.linalg.norm((agreed - square) * weight))
        # Of few pixels every lag is uncertain, and halves agree by chance.
        return square > max(_SIGNIFICANT * error, (self.structure * share * self.at(0, 0)) ** 2)

    def mean_in_tiles(self, cells: np.ndarray, plateau: float) -> tuple[float, float]:
        """Return the mean autocovariance over pairs of a tile, and its standard error.

        The error comes from the differences between frames: infinite of fewer than two with pixels.

        Args:
            cells: Tile of each pixel of a frame, shape (H, W); -1: not used.
            plateau: Subtracted from every lag within reach.
        """
        sizes = np.bincount(cells[cells >= 0])
        total = float((sizes * (sizes - 1)).sum())
        counts = self.counts.sum(0)
        own = np.zeros(len(self.products))
        rows, columns = (min(self.filter_reach, reach) for reach in self.reach)
        for row, column in product(range(rows + 1), range(-columns, columns + 1)):
            if row == 0 and column <= 0:
                continue
            left, right = max(0, -column), max(0, column)
            one = cells[: len(cells) - row, left : cells.shape[1] - right]
            other = cells[row:, right : cells.shape[1] - left]
            pairs = int(((one == other) & (one >= 0)).sum())
            if pairs:
                place = (slice(None), row + self.reach[0], column + self.reach[1])
                excess = self.products[place] - plateau * self.counts[place]
                own += 2 * pairs * excess / max(float(counts[place[1:]]), 1.0)
        own /= max(total, 1.0)
        weight = self.counts[:, self.reach[0], self.reach[1]]
        if (weight > 0).sum() < 2:
            return 0.0, float("inf")
        weight = weight / max(float(weight.sum()), 1.0)
        mean = float(own.sum())
        return mean, float(np.sqrt(np.sum((own - mean * weight) ** 2)))


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
        """Whether a filter that is there would be found."""
        return max(self.error.values()) <= _PRECISE


def shared_noise(
    observations: Observations,
    residual: Tensor,
    sigma: Tensor,
    trust: Tensor,
    *,
    least_repeats: int = 4,
) -> SharedNoise:
    """Estimate what pixels share of their noise.

    Args:
        observations: The M pixels.
        residual: Of the base fit, shape (M,), metres.
        sigma: Noise of the pixels, shape (M,), metres.
        trust: Robust weights, shape (M,); pixels without weight are not used.
        least_repeats: Repeats beyond the first frame of each pose that a standard error needs.
            Chosen.
    """
    frames = _frames(observations)
    used = _image(observations, trust > 0, frames)
    precision = _image(observations, 1 / sigma, frames)
    images = _image(observations, residual / sigma, frames)
    tiles = {form: _cells(observations, own) for form, own in small_tiles(observations).items()}
    together = [np.flatnonzero(np.isin(frames, group)) for group in same_exposure(observations)]
    repeats = [group for group in together if len(group) > 1]
    if sum(len(group) - 1 for group in repeats) >= least_repeats:
        pairs = [_around_mean(images[group], used[group]) for group in repeats]
        values, same = (np.concatenate(part) for part in zip(*pairs, strict=True))
        found = _found(values, same, tiles, from_repeats=True)
        if found.precise or found.striped:
            return found
    step = max(1, len(images) // _MOST_FRAMES)
    away = used & ~_edges(observations, frames)
    found = _found(*_apart_from_pattern(images, precision, away, step), tiles, from_repeats=False)
    if found.precise and away.sum() >= _LEAST_AWAY * used.sum():
        return found
    every = _found(*_apart_from_pattern(images, precision, used, step), tiles, from_repeats=False)
    return every if every.whole < _MOST_WHOLE else found


def _found(
    values: np.ndarray, used: np.ndarray, tiles: Mapping[str, np.ndarray], *, from_repeats: bool
) -> SharedNoise:
    """Estimate what pixels share from images (F, H, W), for tiles (H, W) of every form."""
    lags, share, error = Lags(values, used), {}, {}
    # Noise over that assumed: less where a filter over time makes repeats alike.
    whole = max(lags.at(0, 0) - (0.0 if from_repeats else lags.plateau("squares")), _TINY)
    for form, cells in tiles.items():
        plateau = 0.0 if from_repeats else lags.plateau(form)
        value, own = (x / whole for x in lags.mean_in_tiles(cells, plateau))
        least = max(_SIGNIFICANT * own, 0.0 if from_repeats else _LEAST_SHARE)
        share[form] = min(value, _MOST_SHARE) if value > least else 0.0
        error[form] = own
    most = max(share.values())
    striped = most > 0 and lags.reaches_far(most)
    level = lags.level() if most > 0 and not striped else 1.0
    return SharedNoise(share, error, level, from_repeats, striped, whole / level**2)


def _frames(observations: Observations) -> np.ndarray:
    """Return the frames that are looked at: all that have pixels, or those of some poses."""
    camera, seen = observations.recording.camera, observations.frame.unique().numpy()
    most = max(_MOST_PIXELS // (camera.height * camera.width), _LEAST_FRAMES)
    if len(seen) <= most:
        return seen
    unit = observations.unit.numpy()[seen]
    poses = np.unique(unit)
    places = np.linspace(0, len(poses) - 1, max(len(poses) * most // len(seen), 1)).round()
    return seen[np.isin(unit, poses[places.astype(int)])]


def _image(
    observations: Observations, values: Tensor, frames: np.ndarray, fill: float = 0
) -> np.ndarray:
    """Return values (M,) as images (F, H, W) of some frames; `fill` where there are none."""
    camera = observations.recording.camera
    place = torch.full((observations.num_frames,), -1)
    place[torch.from_numpy(frames)] = torch.arange(len(frames))
    row = place[observations.frame]
    own = row >= 0
    images = torch.full((len(frames), camera.height * camera.width), fill, dtype=values.dtype)
    images[row[own], observations.pixel[own]] = values[own]
    return images.reshape(-1, camera.height, camera.width).numpy()


def _cells(observations: Observations, cells: Tensor) -> np.ndarray:
    """Return the tile of each pixel of the frame with the most pixels, (H, W); -1: not used."""
    frame = torch.bincount(observations.frame).argmax(0, keepdim=True).numpy()
    return _image(observations, cells, frame, -1)[0]


def _around_mean(images: np.ndarray, used: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return what differs between repeats, with the variance of one frame's noise."""
    everywhere = used.all(0)
    around = images - images.mean(0)
    around = around - around[:, everywhere].mean(1)[:, None, None] if everywhere.any() else around
    freedom = (len(images) - 1) / len(images)
    return _clipped(around / freedom**0.5), np.broadcast_to(everywhere, images.shape)


def _apart_from_pattern(
    images: np.ndarray, precision: np.ndarray, used: np.ndarray, step: int
) -> tuple[np.ndarray, np.ndarray]:
    """Return images less what all have in common, and less the offset and tilts of each.

    What they have in common is so in metres. In units of the noise it is smaller where an image is
    darker.

    Args:
        images: Residuals over the standard deviation of the noise, shape (F, H, W).
        precision: One over that standard deviation, shape (F, H, W), 1 / m.
        used: Which pixels count, shape (F, H, W).
        step: Of the images that are returned.
    """
    count, weight, part = used.sum(0), used * precision, slice(None, None, step)
    # The mean of all other images has nothing of an image's own noise.
    others = (weight * images).sum(0) - (weight * images)[part]
    certain = (weight**2).sum(0) - weight[part] ** 2
    own = images[part] - precision[part] * others / np.where(certain > 0, certain, 1.0)
    use = used[part] & (count > 1)
    return _clipped(own - _planes(own, use)), use


def _clipped(values: np.ndarray) -> np.ndarray:
    return np.clip(values, -_CLIP, _CLIP)


def _planes(images: np.ndarray, used: np.ndarray) -> np.ndarray:
    """Return the offset and two tilts of each image, fitted to the used pixels, (F, H, W).

    A pose tilts a whole image; pixels far apart would seem to share that.
    """
    height, width = images.shape[1:]
    row, column = np.linspace(-1, 1, height), np.linspace(-1, 1, width)
    basis = np.stack(np.broadcast_arrays(np.ones((height, width)), row[:, None], column))
    basis = basis.reshape(3, -1)
    flat, weight = images.reshape(len(images), -1), used.reshape(len(images), -1)
    products = (basis[:, None] * basis).reshape(9, -1)
    inner = (weight @ products.T).reshape(-1, 3, 3) + _TINY * np.eye(3)
    own = np.linalg.solve(inner, ((flat * weight) @ basis.T)[..., None])[..., 0]
    return (own @ basis).reshape(images.shape)


def _edges(observations: Observations, frames: np.ndarray) -> np.ndarray:
    """Return where direct neighbours differ in brightness in some frames, (F, H, W)."""
    edges = np.zeros((len(frames), *observations.distance_images.shape[1:]), dtype=bool)
    if observations.amplitude_images is None:
        return edges
    amplitude = observations.amplitude_images.numpy()[frames]
    for one, other in (
        (np.s_[:, :-1], np.s_[:, 1:]),
        (np.s_[:, :, :-1], np.s_[:, :, 1:]),
    ):
        low = np.minimum(amplitude[one], amplitude[other])
        odd = np.abs(amplitude[other] - amplitude[one]) > SAME_BRIGHTNESS * low
        edges[one] |= odd
        edges[other] |= odd
    return edges


def whole_images(observations: Observations) -> Observations | None:
    """Return all pixels of some evenly spread frames; None where all pixels were chosen anyway."""
    if not observations.is_sample:
        return None
    usable = observations.usable
    counts = usable.flatten(1).sum(1)
    seen = torch.nonzero(counts)[:, 0]
    most = max(int(_WHOLE_PIXELS / counts[seen].double().mean()), _LEAST_WHOLE_FRAMES)
    frames = seen[torch.linspace(0, len(seen) - 1, min(most, len(seen))).round().long()]
    number, pixel = usable[frames].flatten(1).nonzero(as_tuple=True)
    frame, images = frames[number], observations.amplitude_images
    return replace(
        observations,
        frame=frame,
        pixel=pixel,
        measured=observations.distance_images.flatten(1)[frame, pixel].double(),
        amplitude=None if images is None else images.flatten(1)[frame, pixel].double(),
    )


def with_level_of_images(
    shared: SharedNoise,
    observations: Observations,
    noise: PixelNoise,
    residual_of: Callable[[Observations], Tensor],
) -> SharedNoise:
    """Return what neighbours share, its level from whole images where pixels were chosen.

    Chosen pixels have no near neighbours, in which a filter shows.

    Args:
        shared: As the chosen pixels show it.
        observations: The chosen pixels.
        noise: That differences between neighbours see.
        residual_of: Returns the residual of a fit in other pixels, metres.
    """
    whole = whole_images(observations)
    if whole is None:
        return shared
    residual, sigma = residual_of(whole), noise.at(brightness_of(whole), whole.frame)
    trust = robust_weights(residual, sigma, Neighbours(whole).common(residual))
    level = max(shared.level, shared_noise(whole, residual, sigma, trust).level)
    return replace(shared, level=level, whole=shared.whole * (shared.level / level) ** 2)
