r"""The residuals of pixels of walls, linear in all that may be wrong, and in smooth forms of it.

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
from dataclasses import dataclass
from functools import cached_property, partial

import torch
from torch import Tensor

from tofcorr.error_terms.base import Domain, Interval
from tofcorr.error_terms.model import ErrorModel, Pixels
from tofcorr.geometry.polynomials import exponents, products
from tofcorr.geometry.rays import tangents

# The kinds of functions of the form: the variables that they are products of, and the highest order
# in each, of the cosines of distance and log amplitude, of the Legendre polynomials of the place in
# the image, of the powers of the angle. Chosen: half a period of the tenth cosine is a twentieth of
# the range, finer than any wiggling within it; coarser in products, for a form that changes with
# two variables is smaller.
_KINDS = {
    ("distance",): (10,),
    ("amplitude",): (6,),
    ("place",): (5,),
    ("distance", "place"): (3, 2),
    ("distance", "amplitude"): (3, 3),
    ("angle",): (2,),
}
CLASSES = len(_KINDS)
"""How many kinds of functions of the form there are; those of one kind share a prior variance."""


def form_functions(domain: Domain, pixels: Pixels, gain: Tensor) -> list[Tensor]:
    """Return functions of distance, amplitude, place and angle, each of about unit size.

    Args:
        domain: The calibrated ranges, which scale the variables.
        pixels: Distance, amplitude and place, M of them.
        gain: Cosine between ray and normal, shape (M,), negative.

    Returns:
        The functions of each kind, shape (H, M); H is 0 where no amplitude was calibrated.
    """
    functions = {
        "distance": partial(_cosines, domain.radial_distance.scale(pixels.radial_distance)),
        "amplitude": lambda orders: gain.new_zeros(0, len(gain)),
        "place": partial(_place, domain, pixels),
        "angle": lambda orders: torch.stack([(4 + 4 * gain) ** k for k in range(1, orders + 1)]),
    }
    if domain.amplitude is not None:
        low, high = domain.amplitude
        low = max(low, high / 1000, torch.finfo(torch.float64).tiny)
        # The logarithms of the range, mapped onto [-1, 1].
        width = math.log(max(high, low) / low) or 1.0
        scaled = 2 * (pixels.amplitude.clamp(min=low) / low).log() / width - 1
        functions["amplitude"] = partial(_cosines, scaled)
    found = []
    for variables, orders in _KINDS.items():
        first, *second = (functions[name](one) for name, one in zip(variables, orders, strict=True))
        found.append((first[:, None] * second[0]).flatten(0, 1) if second else first)
    return found


def form_classes(domain: Domain) -> Tensor:
    """Return the kind of each function, counted from zero, shape (H,)."""
    one = torch.ones(1, dtype=torch.float64)
    found = form_functions(domain, Pixels(*[one] * len(Pixels._fields)), -one)
    counts = torch.tensor([len(functions) for functions in found])
    return torch.repeat_interleave(torch.arange(CLASSES), counts)


def _cosines(scaled: Tensor, orders: int) -> Tensor:
    """Return cos(k pi (s + 1) / 2) / k for k from 1, shape (orders, M)."""
    order = torch.arange(1, orders + 1).to(scaled)[:, None]
    return torch.cos(order * (math.pi / 2) * (scaled + 1)) / order


def _place(domain: Domain, pixels: Pixels, highest: int) -> Tensor:
    """Return polynomials of the place up to a total degree, shape (H, M)."""
    row, column = (
        2 * at.double() / max(size - 1, 1) - 1
        for at, size in ((pixels.rows, domain.height), (pixels.columns, domain.width))
    )
    return torch.stack(products(column, row, 1, highest))


# Lowest and highest total degree of what bends an image, without plane and tilts. Chosen: they hold
# three in four parts of an error that varies over a third of the image.
_BENDS = (2, 4)
SHAPES = len(exponents(*_BENDS))
"""How many smooth shapes may differ from image to image."""
BOWS = 3
"""How many of the shapes, the first ones, are of degree 2: a bow across, along and diagonally."""


@dataclass(frozen=True, eq=False)
class LinearPixels:
    """M pixels of walls: what the model leaves of them, and what changes that.

    Attributes:
        pixels: As measured, but the distance: that which the camera should measure, which has no
            noise. So everything but the residual stands where the wall is: else a scale of the
            distance would explain the noise.
        ray: Unit rays in the camera frame, shape (M, 3).
        normal: Of the walls in the camera frame, shape (M, 3).
        distance: To the wall along the ray, shape (M,), metres.
        residual: Distances of the corrected points to the plane, shape (M,), metres.
        gain: Their change by an error of the distance along the ray, shape (M,), negative: the
            cosine between ray and normal.
        unknowns: Their change by the twist (if it was estimated), the model's coefficients and
            what was asked for besides, shape (M, P).
    """

    pixels: Pixels
    ray: Tensor
    normal: Tensor
    distance: Tensor
    residual: Tensor
    gain: Tensor
    unknowns: Tensor

    @property
    def points(self) -> Tensor:
        """Points of the wall in the camera frame, shape (M, 3), metres."""
        return self.ray * self.distance[:, None]

    @cached_property
    def moves(self) -> Tensor:
        """Change of the residuals of one image by two turns and a shift of its wall, (M, 3)."""
        points = self.points
        return wall_moves(points - points.mean(dim=0), self.normal[0])

    @cached_property
    def shapes(self) -> Tensor:
        """Change by smooth errors of this image alone, shape (M, S)."""
        return self.gain[:, None] * shapes(self.pixels.rows, self.pixels.columns).T


def linearised(
    error: ErrorModel,
    pixels: Pixels,
    ray: Tensor,
    plane: tuple[Tensor, Tensor],
    shown: tuple[Tensor, Tensor] | None = None,
    *,
    twist: bool,
    domain: Domain | None = None,
) -> LinearPixels:
    """Return the linear form of the residuals of some pixels.

    Args:
        error: The error model.
        pixels: As measured.
        ray: Their unit rays, shape (M, 3).
        plane: Their walls in the camera frame: unit normal (3,) or (M, 3), and offset, metres.
        shown: The walls where the images show them, if that is not the same.
        twist: Whether the hand-eye transform was estimated.
        domain: The calibrated ranges, for the functions by which the form may be wrong; None:
            these are not wanted.
    """
    normal, offset = plane
    gain = (ray * normal).sum(-1)
    corrected = pixels.radial_distance - error.error_at(pixels)
    where, away = plane if shown is None else shown
    distance = -away / (ray * where).sum(-1)
    pixels = pixels._replace(radial_distance=pixels.radial_distance - corrected + distance)
    forms = [] if domain is None else form_functions(domain, pixels, gain)
    with torch.no_grad():
        columns = torch.cat([error.columns_at(pixels), *forms])
    unknowns, normals = -gain[:, None] * columns.T, normal.expand_as(ray)
    if twist:
        turned = torch.linalg.cross(ray * distance[:, None], normals)
        unknowns = torch.cat([normals, turned, unknowns], dim=1)
    residual = gain * corrected + offset
    return LinearPixels(pixels, ray, normals, distance, residual, gain, unknowns)


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


def shapes(rows: Tensor, columns: Tensor) -> Tensor:
    """Return smooth shapes over the part of an image that is used, shape (S, M).

    They are Legendre polynomials of total degree 2 to 4 over the bounding box of the pixels: what
    bends one image and not the next, such as multipath, and is no tilt of the wall.

    Args:
        rows: Of the pixels, shape (M,).
        columns: Of the pixels, shape (M,).
    """
    across, along = (
        Interval(float(one.min()), float(one.max())).scale(one).double() for one in (rows, columns)
    )
    return torch.stack(products(along, across, *_BENDS))


# Sides of the blocks, pixels. Chosen: twice as large each, up to a tenth of an image; what is alike
# over more bends the image, and has its own effects.
_SIDES = (2, 4, 8, 16, 32)


def block_squares(image: LinearPixels, weight: Tensor) -> Tensor:
    """Return how much alike neighbouring residuals are, without plane and smooth shapes.

    Args:
        image: One image.
        weight: Of its pixels, shape (M,): one over the variance that their noise has.

    Returns:
        For each side of blocks the squares of their sums, what independent pixels would give, and
        degrees of freedom, shape (K, 3), to be added up; zeros where there are too few blocks.
    """
    root = weight.sqrt()
    own = torch.cat([image.gain[:, None], image.moves, image.shapes], dim=1)
    q = torch.linalg.qr(own * root[:, None]).Q
    residual = image.residual * root
    residual = residual - q @ (q.T @ residual)
    pixels, unknowns = q.shape
    noise = residual.square().sum() / max(pixels - unknowns, 1)
    lines = torch.zeros(len(_SIDES), 3).to(residual)
    for line, side in zip(lines, _SIDES, strict=True):
        # No image has so many columns of blocks.
        place = image.pixels.rows // side * 10_000 + image.pixels.columns // side
        names, block = torch.unique(place, return_inverse=True)
        # With fewer than two blocks for each quantity fitted to the image, the fit leaves nothing
        # of a block's mean.
        if len(names) < 2 * unknowns or noise <= 0:
            continue
        sums = torch.zeros(len(names), 1 + unknowns).to(residual)
        sums = sums.index_add_(0, block, torch.cat([residual[:, None], q], dim=1))
        line[0] = sums[:, 0].square().sum() / noise
        line[1] = pixels - sums[:, 1:].square().sum()
        line[2] = len(names) - unknowns
    return lines


def design_effect(squares: Tensor) -> float:
    """Return the variance of a sum of neighbouring residuals over that of independent ones.

    Args:
        squares: The sum of `block_squares` over the images.

    Returns:
        At least 1, which stands for independent pixels. Larger blocks must show two standard
        deviations more than smaller ones: by chance they do once in forty times.
    """
    effect = 1.0
    for seen, expected, freedom in squares.tolist():
        if freedom > 0 and seen / expected * (1 - 2 * math.sqrt(2 / freedom)) > effect:
            effect = seen / expected
    return effect
