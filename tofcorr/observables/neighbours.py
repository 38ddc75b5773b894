"""Sums over pairs of neighbouring pixels, from which noise and its correlation follow."""

from dataclasses import dataclass, field

import numpy as np

LAGS = (1, 2)
"""Distances of the neighbours whose correlation is estimated, pixels. Chosen: two tell how fast it
falls, and with it the width of a filter."""
AXES = (1, 0)
"""Axes of an image (H, W): along a row, and along a column."""
SPACING = 3
"""Spacing of second differences, pixels. Cameras filter their images, so that nearer pixels share
much of their noise; over longer ones surfaces bend. Chosen."""
SAME_BRIGHTNESS = 0.25
"""Neighbours whose amplitudes differ by more than this share (no unit) are not compared: they have
different errors. Chosen."""
SECOND_DIFFERENCE = 1.5
"""Variance of x - (left + right) / 2 for independent noise of variance one: 1 + 1/4 + 1/4."""


def shifted_pair(images: np.ndarray, axis: int, lag: int) -> tuple[np.ndarray, np.ndarray]:
    """Return images (..., H, W) without their last, and without their first `lag` lines."""
    before = [slice(None)] * images.ndim
    after = [slice(None)] * images.ndim
    along = images.ndim - 2 + axis
    before[along], after[along] = slice(None, -lag), slice(lag, None)
    return images[tuple(before)], images[tuple(after)]


def differences(
    images: np.ndarray, amplitude: np.ndarray | None, axis: int, lag: int
) -> np.ndarray:
    """Return differences of pixels `lag` apart; NaN if one is unknown, or differs in brightness."""
    first, second = shifted_pair(images, axis, lag)
    difference = second - first
    if amplitude is not None:
        difference = np.where(alike(amplitude, axis, lag), difference, np.nan)
    return difference


def alike(amplitude: np.ndarray, axis: int, lag: int) -> np.ndarray:
    """Return whether pixels `lag` apart are about equally bright, bool; of (..., H, W)."""
    first, second = shifted_pair(amplitude, axis, lag)
    return np.abs(second - first) < SAME_BRIGHTNESS * (second + first) / 2


def second_differences(images: np.ndarray, amplitude: np.ndarray | None, axis: int) -> np.ndarray:
    """Return x - (left + right) / 2 over the spacing, scaled to the variance of one pixel.

    Args:
        images: Shape (..., H, W), metres; NaN where unknown.
        amplitude: Shape (..., H, W); None: unknown.
        axis: 1: along a row; 0: along a column.

    Returns:
        Shape (..., H, W), metres; NaN at the border, and where a pixel is unknown or its neighbours
        differ in brightness.
    """
    found = np.full(images.shape, np.nan)
    if images.shape[images.ndim - 2 + axis] <= 2 * SPACING:
        return found
    step = differences(images, amplitude, axis, SPACING)
    before, after = shifted_pair(step, axis, SPACING)
    inside = [slice(None)] * images.ndim
    inside[images.ndim - 2 + axis] = slice(SPACING, -SPACING)
    found[tuple(inside)] = (before - after) / 2 / SECOND_DIFFERENCE**0.5
    return found


class BetweenPoses:
    """What images of different poses have in common, pixel by pixel.

    Args:
        shape: Height and width of the camera's images.
    """

    def __init__(self, shape: tuple[int, int]) -> None:
        self._sums = np.zeros((4, *shape))
        self._variance: float | None = None

    def add(self, image: np.ndarray, weight: np.ndarray, corner: tuple[int, int]) -> None:
        """Add a part of the mean image of one pose.

        Args:
            image: NaN where unknown, shape (h, w).
            weight: Its weights, shape (h, w).
            corner: Row and column of its first pixel in the camera's image.
        """
        weight = np.where(np.isfinite(image), weight, 0.0)
        value = weight * np.where(weight > 0, image, 0.0)
        (row, column), (height, width) = corner, image.shape
        part = self._sums[:, row : row + height, column : column + width]
        for total, added in zip(part, (value, value**2, weight, weight**2), strict=True):
            np.add(total, added, out=total)
        self._variance = None

    def variance(self) -> float:
        """Return the mean product of two poses in one pixel: the variance of a fixed pattern."""
        if self._variance is None:
            total, squares, weight, weight_squares = self._sums
            pairs = float((weight**2 - weight_squares).sum())
            shared = float((total**2 - squares).sum())
            self._variance = max(shared / pairs, 0.0) if pairs > 0 else 0.0
        return self._variance


@dataclass(eq=False)
class LagSums:
    """Sums of one kind for the poses, axes and lags, to be divided by each other.

    Of deviations between frames: products of neighbours, and squares. Within images: half squares
    of differences of neighbours, and squares of the scaled second differences at the same pixels.
    """

    products: list[np.ndarray] = field(default_factory=list)
    squares: list[np.ndarray] = field(default_factory=list)
    counts: list[np.ndarray] = field(default_factory=list)

    def add(self, products: np.ndarray, squares: np.ndarray, counts: np.ndarray) -> None:
        """Add the sums (2, 2) of one pose, axes by lags, and the numbers of their entries."""
        self.products.append(products)
        self.squares.append(squares)
        self.counts.append(counts)

    def correlation(self, pose: int | None = None) -> np.ndarray:
        """Return products over squares, (2, 2), of one pose or of all; NaN where there are none."""
        chosen = slice(None) if pose is None else slice(pose, pose + 1)
        return quotient(np.sum(self.products[chosen], axis=0), np.sum(self.squares[chosen], axis=0))


def quotient(over: np.ndarray, under: np.ndarray) -> np.ndarray:
    """Return one array divided by another; NaN where that is not positive."""
    return np.divide(over, under, out=np.full(np.shape(under), np.nan), where=under > 0)
