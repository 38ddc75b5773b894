r"""By how much a camera reads too far, from corrected images of walls.

The residuals of an image are linear in the offset :math:`\delta`, in what the calibration left
unknown (with the mean and covariance of its `Reference`), in the wall's unknown place, and in an
error of the robot's pose for each image. All are estimated together by generalised least squares,
so the interval of the offset holds the uncertainty of the calibration, of its form, of the poses
and of the pixels' noise.
"""

import math
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from tofcorr.drift.corrected_images import CorrectedImage, Wall
from tofcorr.estimation.random_effects import GroupSums, Reduced, inverse, reduced
from tofcorr.estimation.student import f_tail
from tofcorr.fit.reference.reference import Reference, pixel_weights

# Standard deviation of the prior on the place of a wall shared by all images, metres and radians:
# wide enough for any wall, so that only the images place it.
_ANYWHERE = 10.0
# Probability of the images' disagreement below which they do not belong together: one false
# headline in a thousand checks.
_DISAGREES = 1e-3


class Offset(NamedTuple):
    """The offset along the ray; positive where the camera reads too far.

    Attributes:
        value: Of all images, metres.
        standard_error: Of that value, metres.
        degrees_of_freedom: Of the standard error.
        of_image: Each image's own offset, shape (N,), metres.
        disagreement: By how much the images depart from each other, as a standard deviation over
            that of the calibration's images.
        disagrees: Whether that is too much for images of one camera, one robot and flat walls.
    """

    value: float
    standard_error: float
    degrees_of_freedom: float
    of_image: np.ndarray
    disagreement: float
    disagrees: bool


class _Solution(NamedTuple):
    """The offset for given variances.

    Attributes:
        value: Metres.
        variance: Of it.
        of_images: The part of the variance that would be left if the calibration were exact.
        spread: Mean square of the images' departures over what was expected of them.
        of_image: The offset of each image by itself, shape (N,).
    """

    value: float
    variance: float
    of_images: float
    spread: float
    of_image: np.ndarray


@dataclass
class OffsetSums:
    """Sums of products over the pixels of each image, image by image.

    Attributes:
        reference: What the calibration knows, and how its images departed from it.
    """

    reference: Reference
    _products: list[Tensor] = field(default_factory=list)
    _count: list[int] = field(default_factory=list)
    _shared_walls: int = 0
    _shapes: int = 0

    def __post_init__(self) -> None:
        """Standardise what the calibration left unknown."""
        self._factor = _factor(self.reference.covariance)

    def add(self, image: CorrectedImage) -> None:
        """Add an image: offset, shared wall, calibration, own wall, residual."""
        linear, shared = image.linear, [] if image.shared_wall is None else [image.shared_wall]
        residual = linear.residual - linear.unknowns @ self.reference.mean
        known = linear.unknowns @ self._factor
        own = [linear.moves, linear.shapes, residual[:, None]]
        parts = [linear.gain[:, None], *shared, known, *own]
        columns = torch.cat(parts, dim=1)
        weight = pixel_weights(self.reference.noise, linear)
        self._products.append(columns.T @ (weight[:, None] * columns))
        self._count.append(len(residual))
        self._shared_walls, self._shapes = 3 * len(shared), linear.shapes.shape[1]

    def estimate(self, wall: Wall) -> Offset:
        """Return the offset of all images with its standard error.

        Images may depart from each other more, or less, than those of the calibration did: their
        variances are scaled by the spread seen in both together, or in these alone where the two
        surely differ.

        Args:
            wall: What is known of the wall.
        """
        sums = GroupSums(
            torch.stack(self._products), torch.tensor(self._count).double(), 3 + self._shapes
        )
        left = torch.stack([_squares_left(products, sums.random) for products in sums.products])
        noise = left / (sums.size - sums.random - 1).clamp(min=1)
        of_pose = 1 / self.reference.pose_variance
        if wall == "per_image":
            of_pose = torch.zeros_like(of_pose)
        of_shapes = torch.full((self._shapes,), 1 / self.reference.shape_variance).to(of_pose)
        precision = torch.cat([of_pose, of_shapes])
        first = self._solve(sums, noise, precision)
        known, own = max(self.reference.poses - 1, 0), len(self._count) - 1
        disagrees = bool(own and known) and f_tail(first.spread, own, known) < _DISAGREES
        known = 0 if disagrees else known
        freedom = max(known + own, 1)
        spread = (known + own * first.spread) / freedom if known + own else 1.0
        found = self._solve(sums, noise * spread, precision / spread)
        calibration = max(found.variance - found.of_images, 0.0)
        # Satterthwaite: degrees of freedom of a sum of two estimated variances.
        squares = found.of_images**2 / freedom + calibration**2 / max(self.reference.poses - 1, 1)
        return Offset(
            value=found.value,
            standard_error=math.sqrt(found.variance),
            degrees_of_freedom=found.variance**2 / squares,
            of_image=found.of_image,
            disagreement=math.sqrt(first.spread),
            disagrees=disagrees,
        )

    def _solve(self, sums: GroupSums, noise: Tensor, pose_precision: Tensor) -> _Solution:
        images = reduced(sums, noise, pose_precision)
        prior = torch.ones(sums.unknowns, dtype=torch.float64)
        few = slice(0, 1 + self._shared_walls)
        prior[few] = _ANYWHERE**-2
        prior[0] = 0.0
        precision = images.precision.sum(dim=0) + prior.diag()
        covariance = inverse(precision)
        solution = covariance @ images.right.sum(dim=0)
        scores = (images.right - images.precision @ solution)[:, 0]
        return _Solution(
            value=float(solution[0]),
            variance=float(covariance[0, 0]),
            of_images=float(inverse(precision[few, few])[0, 0]),
            spread=_spread(scores, images),
            of_image=(solution[0] + scores / images.precision[:, 0, 0]).numpy(),
        )


def _factor(covariance: Tensor) -> Tensor:
    """Return F with F F^T the covariance, also where that is singular."""
    scale = covariance.diagonal().clamp(min=1e-300).sqrt()
    values, vectors = torch.linalg.eigh(covariance / scale[:, None] / scale[None, :])
    return scale[:, None] * vectors * values.clamp(min=0).sqrt()


def _squares_left(products: Tensor, random: int) -> Tensor:
    """Return the sum of squares that offset, wall and shapes leave of one image's residuals."""
    size = len(products)
    kept = [0, *range(size - random - 1, size - 1)]
    own, right = products[kept][:, kept], products[kept, -1]
    scale = own.diagonal().clamp(min=1e-300).rsqrt()
    inverted = torch.linalg.pinv(own * scale[:, None] * scale[None, :], hermitian=True)
    return products[-1, -1] - (right * scale) @ inverted @ (right * scale)


def _spread(scores: Tensor, images: Reduced) -> float:
    """Return the mean square of the images' scores over what was expected; 1 for one image."""
    count = len(scores)
    expected = images.precision[:, 0, 0]
    return float((scores.square() / expected).sum() / (count - 1)) if count > 1 else 1.0
