"""How values of neighbouring pixels vary together, as a function of how far apart they are."""

from collections.abc import Sequence

import numpy as np

from tofcorr.observables.neighbours import SECOND_DIFFERENCE, SPACING

# Filters reach this far, pixels: farther pixels share no noise. Chosen: three standard deviations
# of a filter of 2.7 pixels; vendors' filters have 3 to 7 taps.
_REACH = 8
# The plateau is the mean over the lags from `_REACH` to this one, pixels. Chosen: five lags.
_PLATEAU = 12
# Least share of the variance of second differences that correlation may leave. Chosen: bounds the
# correction to 2.
_LEAST_LEFT = 0.25
# Correlation beyond a filter's reach is structure if it varies by more than this share of that of
# neighbours. Set on openings 1 to 4 of `benchmarks.renewed`: stripes 0.3 to 0.7, filters below 0.1.
_FAR = 0.25
# And if both halves of the frames agree in it by this many standard errors. The usual convention.
_SIGNIFICANT = 3.0


def _round_length(length: int) -> int:
    """Return a length, no smaller, that a Fourier transform takes little time for.

    It is a multiple of 16; prime factors above 100 take several times as long.
    """
    return -(-length // 16) * 16


class Lags:
    """Autocovariance over lags up to `_PLATEAU` rows and columns, frame by frame.

    Args:
        values: Images of mean zero, shape (F, H, W).
        used: Which pixels count, bool, shape (F, H, W).
    """

    def __init__(self, values: np.ndarray, used: np.ndarray) -> None:
        height, width = values.shape[1:]
        size = (_round_length(height + _PLATEAU), _round_length(width + _PLATEAU))
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
        near = [(self.at(0, k * SPACING) - plateau) / own for k in (1, 2)]
        seen = 1 - (2 * near[0] - near[1] / 2) / SECOND_DIFFERENCE
        return float(np.clip(seen, _LEAST_LEFT, 1.0) ** -0.5)

    def reaches_far(self, share: float) -> bool:
        """Return whether pixels farther apart than a filter reaches vary together, or oppositely.

        Narrow stripes do this, and neighbours share them as they would share filtered noise. Only
        what the first and the second half of the frames agree in counts.

        Args:
            share: What neighbours share, over the variance of a pixel.
        """
        rows, columns = (np.abs(np.arange(-reach, reach + 1)) for reach in self.reach)
        far = np.maximum(rows[:, None], columns) >= _REACH
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
        return square > max(_SIGNIFICANT * error, (_FAR * share * self.at(0, 0)) ** 2)

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
        for row, column, pairs in _pairs(cells, self.reach):
            place = (slice(None), row + self.reach[0], column + self.reach[1])
            here = max(float(counts[place[1:]]), 1.0)
            excess = self.products[place] - plateau * self.counts[place]
            own += 2 * pairs * excess / here
        own /= max(total, 1.0)
        weight = self.counts[:, self.reach[0], self.reach[1]]
        if (weight > 0).sum() < 2:
            return 0.0, float("inf")
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
