r"""The residual of one image, linear in all that may be wrong, and in smooth forms of it.

.. math:: r_v = n \cdot \big(R\,a_v (D_v - E_v) + t\big) + d

changes with the hand-eye's twist, the model's coefficients, the functions by which its form may be
wrong, and the wall's place: two turns and a shift, which an error of the robot's pose gives to each
image. With :math:`g_v = n \cdot a_v`, an error of the distance along the ray changes it by
:math:`g_v`. A cubic cannot follow every wiggling, and a quadratic not every lens: what is left is
described by many smooth functions of a pixel's circumstances, each with a prior whose size the
residuals of the calibration tell.

Errors of neighbouring pixels are alike: filters of the camera, the print of a board, and multipath
see to that. A fit that takes them as independent believes itself far too sure. With :math:`S_b` the
sum of the residuals of block b, :math:`\sum_b S_b^2` grows with the size of the blocks until they
are larger than what is alike; how much larger it is then than for independent pixels is the design
effect of survey sampling (Kish 1965).
"""

import math
from dataclasses import dataclass, field
from typing import NamedTuple

import torch
from numpy.polynomial.legendre import legvander
from torch import Tensor

from tofcorr.data.recording import FrameBatch
from tofcorr.error_terms.base import Domain, Interval
from tofcorr.error_terms.model import ErrorModel, Pixels
from tofcorr.geometry.rays import tangents
from tofcorr.pixels.sample import pixels_of_image

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


def _legendre(scaled: Tensor, degree: int) -> Tensor:
    """Return the Legendre polynomials up to a degree, shape (degree + 1, M)."""
    return torch.from_numpy(legvander(scaled.double().numpy(), degree)).movedim(-1, 0)


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


class LinearImage(NamedTuple):
    """One image, M pixels.

    Attributes:
        residual: Distances of the corrected points to the plane, shape (M,), metres.
        gain: Their change by an error of the distance along the ray, shape (M,).
        points: Points of the wall in the camera frame, shape (M, 3), metres.
        moves: Change of the residual by two turns and a shift of the wall, shape (M, 3).
        shapes: Change by smooth errors of this image alone, shape (M, S).
        unknowns: Change by the twist (if it was estimated), the model's coefficients and the
            functions of its form, shape (M, P).
        amplitude: Of each pixel, shape (M,); None without amplitudes.
        rows: Of the pixels in the image, shape (M,).
        columns: The same.
        normal: Of the wall in the camera frame, shape (3,).
    """

    residual: Tensor
    gain: Tensor
    points: Tensor
    moves: Tensor
    shapes: Tensor
    unknowns: Tensor
    amplitude: Tensor | None
    rows: Tensor
    columns: Tensor
    normal: Tensor


class Linearisation(NamedTuple):
    """Gives the linear form of an image under one calibration.

    Attributes:
        error: The error model.
        forms: Functions by which its form may be wrong.
        ray_directions: Unit rays, shape (H, W, 3).
        twist: Whether the hand-eye transform was estimated.
    """

    error: ErrorModel
    forms: FormFunctions
    ray_directions: Tensor
    twist: bool

    def __call__(
        self,
        batch: FrameBatch,
        k: int,
        used: Tensor,
        plane: tuple[Tensor, Tensor],
        shown: tuple[Tensor, Tensor] | None = None,
    ) -> LinearImage:
        """Return image k of a batch.

        Args:
            batch: The images, distances as measured.
            k: Which one.
            used: Numbers of the pixels, counted row by row, shape (M,).
            plane: The wall in the camera frame: unit normal (3,) and offset, metres.
            shown: The wall where the image shows it, if that is not the same.
        """
        normal, offset = plane
        pixels = pixels_of_image(batch, k, used)
        rays = self.ray_directions.flatten(0, 1)[used]
        corrected = pixels.radial_distance - self.error.error_at(pixels)
        gain = rays @ normal
        residual = gain * corrected + offset
        # What changes the residuals is computed where the wall is, not where noise puts the pixels:
        # else a scale of the distance would explain the noise.
        smooth = -(offset if shown is None else shown[1]) / (
            gain if shown is None else rays @ shown[0]
        )
        pixels = pixels._replace(radial_distance=pixels.radial_distance - corrected + smooth)
        points = rays * smooth[:, None]
        with torch.no_grad():
            columns = torch.cat([self.error.columns_at(pixels), self.forms(pixels, gain)])
        unknowns = -gain[:, None] * columns.T
        if self.twist:
            turned = torch.linalg.cross(points, normal.expand_as(points))
            unknowns = torch.cat([normal.expand_as(points), turned, unknowns], dim=1)
        return LinearImage(
            residual=residual,
            gain=gain,
            points=points,
            moves=wall_moves(points - points.mean(dim=0), normal),
            shapes=gain[:, None] * shapes(pixels.rows, pixels.columns).T,
            unknowns=unknowns,
            amplitude=None if batch.amplitude is None else pixels.amplitude,
            rows=pixels.rows,
            columns=pixels.columns,
            normal=normal,
        )


def wall_moves(points: Tensor, normal: Tensor, world_from_camera: Tensor | None = None) -> Tensor:
    """Return the change of the residuals by two turns and a shift of the wall, shape (M, 3).

    Args:
        points: In the camera frame, shape (M, 3), metres.
        normal: The wall's unit normal in the camera frame, shape (3,).
        world_from_camera: Pose (4, 4) for a wall that does not move with the camera; None: the
            wall of each image is by itself.
    """
    if world_from_camera is not None:
        points = points @ world_from_camera[:3, :3].T + world_from_camera[:3, 3]
        normal = world_from_camera[:3, :3] @ normal
    return torch.cat([points @ tangents(normal).T, torch.ones_like(points[:, :1])], dim=1)


# Sides of the blocks, pixels. Chosen: twice as large each, up to a tenth of an image; what is alike
# over more bends the image, and has its own effects.
_SIDES = (2, 4, 8, 16, 32)
# Fewest blocks for each quantity that was fitted to the image: with fewer the fit leaves nothing of
# a block's mean. Chosen.
_BLOCKS_OF_UNKNOWN = 2
# Standard deviations by which larger blocks must show more than smaller ones to be believed: by
# chance they do once in forty times.
_SURELY = 2.0


@dataclass
class Correlation:
    """Adds up, image by image, how much alike neighbouring residuals are."""

    _sums: Tensor = field(default_factory=lambda: torch.zeros(len(_SIDES), 3, dtype=torch.float64))

    def add(self, image: LinearImage, weight: Tensor) -> None:
        """Add an image, without its plane and its smooth shapes.

        Args:
            image: The image.
            weight: Of its pixels, shape (M,): one over the variance that their noise has.
        """
        self._sums += _squares(image, weight.sqrt())

    def design_effect(self) -> float:
        """Return the variance of a sum of neighbouring residuals over that of independent ones.

        At least 1, which stands for independent pixels.
        """
        effect = 1.0
        for seen, expected, freedom in self._sums.tolist():
            if freedom > 0 and seen / expected * (1 - _SURELY * math.sqrt(2 / freedom)) > effect:
                effect = seen / expected
        return effect


def _squares(image: LinearImage, root: Tensor) -> Tensor:
    """Return squares of block sums, what independent pixels would give, and degrees of freedom.

    One line for each side of blocks, shape (K, 3); zeros where there are too few blocks.
    """
    own = torch.cat([image.gain[:, None], image.moves, image.shapes], dim=1)
    q = torch.linalg.qr(own * root[:, None]).Q
    residual = image.residual * root
    residual = residual - q @ (q.T @ residual)
    pixels, unknowns = q.shape
    noise = residual.square().sum() / max(pixels - unknowns, 1)
    lines = torch.zeros(len(_SIDES), 3).to(residual)
    for line, side in zip(lines, _SIDES, strict=True):
        names, block = torch.unique(
            image.rows // side * 10_000 + image.columns // side, return_inverse=True
        )
        if len(names) < _BLOCKS_OF_UNKNOWN * unknowns or noise <= 0:
            continue
        sums = torch.zeros(len(names), 1 + unknowns).to(residual)
        sums = sums.index_add_(0, block, torch.cat([residual[:, None], q], dim=1))
        line[0] = sums[:, 0].square().sum() / noise
        line[1] = pixels - sums[:, 1:].square().sum()
        line[2] = len(names) - unknowns
    return lines
