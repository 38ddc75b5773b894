"""Smooth functions of a pixel's circumstances, by which a model's form may be wrong.

A cubic cannot follow every wiggling, and a quadratic not every lens. What is left is described by
many smooth functions, each with a prior whose size the residuals of the calibration tell.
"""

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from tofcorr.error_terms.domain import Domain, Interval
from tofcorr.error_terms.model import Pixels

CLASSES = (
    "distance",
    "amplitude",
    "place",
    "distance and place",
    "distance and amplitude",
    "angle",
)
"""The kinds of functions; those of one kind share a prior variance."""

# Highest order of the cosines of distance and of log amplitude, and of the Legendre polynomials of
# the place in the image. Chosen: half a period of the tenth is a twentieth of the range, finer than
# any wiggling within it.
_DISTANCE, _AMPLITUDE, _PLACE = 10, 6, 5
# The same in products of two variables. Chosen: coarser, for a form that changes with two is
# smaller.
_DISTANCE_OF_PRODUCT, _AMPLITUDE_OF_PRODUCT, _PLACE_OF_PRODUCT = 3, 3, 2

BOWS = 3
"""How many of the shapes, the first ones, are of degree 2: a bow across, along and diagonally."""

# Highest degree of the shapes that differ from image to image. Chosen: they hold three in four
# parts of an error that varies over a third of the image.
_SHAPE = 4
SHAPES = (_SHAPE + 1) * (_SHAPE + 2) // 2 - 3
"""How many shapes there are: all products up to that degree, without plane and tilts."""


@dataclass(frozen=True)
class FormFunctions:
    """Functions of distance, amplitude, place and angle, each of about unit size.

    Attributes:
        domain: The calibrated ranges, which scale the variables.
    """

    domain: Domain

    def classes(self) -> Tensor:
        """Return the place in `CLASSES` of each function's kind, shape (H,)."""
        place, of_product = _degrees(_PLACE), _degrees(_PLACE_OF_PRODUCT)
        counts = [_DISTANCE, 0, len(place), _DISTANCE_OF_PRODUCT * len(of_product), 0, 2]
        if self.domain.amplitude is not None:
            counts[1], counts[4] = _AMPLITUDE, _DISTANCE_OF_PRODUCT * _AMPLITUDE_OF_PRODUCT
        return torch.repeat_interleave(torch.arange(len(CLASSES)), torch.tensor(counts))

    def __call__(self, pixels: Pixels, gain: Tensor) -> Tensor:
        """Return the functions at some pixels, shape (H, M).

        Args:
            pixels: Distance, amplitude and place.
            gain: Cosine between ray and normal, shape (M,), negative.
        """
        domain = self.domain
        distance = _cosines(domain.radial_distance.scale(pixels.radial_distance), _DISTANCE)
        row = 2 * pixels.rows / max(domain.height - 1, 1) - 1
        column = 2 * pixels.columns / max(domain.width - 1, 1) - 1
        rows, columns = _legendre(row, _PLACE), _legendre(column, _PLACE)
        place = torch.stack([rows[i] * columns[j] for i, j in _degrees(_PLACE)])
        coarse = torch.stack([rows[i] * columns[j] for i, j in _degrees(_PLACE_OF_PRODUCT)])
        angle = 4 * (1 + gain)
        signal, mixed = distance[:0], distance[:0]
        if domain.amplitude is not None:
            signal = _cosines(_log_scaled(pixels.amplitude, *domain.amplitude), _AMPLITUDE)
            mixed = _products(distance[:_DISTANCE_OF_PRODUCT], signal[:_AMPLITUDE_OF_PRODUCT])
        both = _products(distance[:_DISTANCE_OF_PRODUCT], coarse)
        angles = torch.stack([angle, angle.square()])
        return torch.cat([distance, signal, place, both, mixed, angles])


def shapes(rows: Tensor, columns: Tensor) -> Tensor:
    """Return smooth shapes over the part of an image that is used, shape (S, M).

    They are Legendre polynomials of total degree 2 to 4 over the bounding box of the pixels: what
    bends one image and not the next, such as multipath, and is no tilt of the wall.

    Args:
        rows: Of the pixels, shape (M,).
        columns: Of the pixels, shape (M,).
    """
    across, along = (
        _legendre(Interval(float(one.min()), float(one.max())).scale(one), _SHAPE)
        for one in (rows, columns)
    )
    return torch.stack([across[i] * along[j] for i, j in _degrees(_SHAPE) if i + j > 1])


def _cosines(scaled: Tensor, orders: int) -> Tensor:
    """Return cos(k pi (s + 1) / 2) / k for k from 1, shape (orders, M)."""
    order = torch.arange(1, orders + 1).to(scaled)[:, None]
    return torch.cos(order * (math.pi / 2) * (scaled + 1)) / order


def _legendre(scaled: Tensor, degree: int) -> list[Tensor]:
    """Return the Legendre polynomials up to a degree."""
    found = [torch.ones_like(scaled), scaled]
    for k in range(1, degree):
        found.append(((2 * k + 1) * scaled * found[k] - k * found[k - 1]) / (k + 1))
    return found


def _degrees(highest: int) -> list[tuple[int, int]]:
    """Return the degrees in row and column of total degree 1 to `highest`."""
    return [(i, total - i) for total in range(1, highest + 1) for i in range(total + 1)]


def _products(first: Tensor, second: Tensor) -> Tensor:
    return (first[:, None] * second[None]).flatten(0, 1)


def _log_scaled(amplitude: Tensor, low: float, high: float) -> Tensor:
    """Map the logarithms of an amplitude's range onto [-1, 1]."""
    low = max(low, 1e-3 * high, 1e-12)
    width = max(math.log(high / low), 1e-6) if high > low else 1.0
    return 2 * (amplitude.clamp(min=low) / low).log() / width - 1
