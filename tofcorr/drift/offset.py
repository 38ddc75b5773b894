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
from tofcorr.estimation.statistics import f_tail, student_quantile
from tofcorr.fit.reference.correlation import Correlation
from tofcorr.fit.reference.form_functions import BOWS
from tofcorr.fit.reference.reference import Reference, pixel_weights, repeated
from tofcorr.fit.reference.scatter import own_noise

# Confidence level of the offset's interval, on which the verdict rests. The usual convention.
_LEVEL = 0.95
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
        half_width: Of its 95 % interval, metres.
        of_image: Each image's own offset, shape (N,), metres.
        disagreement: By how much the images depart from each other, as a standard deviation over
            that of the calibration's images.
        disagrees: Whether that is too much for images of one camera, one robot and flat walls.
    """

    value: float
    half_width: float
    of_image: np.ndarray
    disagreement: float
    disagrees: bool


class _Solution(NamedTuple):
    """The offset for given variances.

    Attributes:
        value: Metres.
        variance: Of it.
        of_images: The part of the variance that would be left if the calibration were exact and
            the wall had no bow.
        of_bow: The part by the bow of the wall.
        spread: Mean square of the images' departures over what was expected of them.
        of_image: The offset of each image by itself, shape (N,).
    """

    value: float
    variance: float
    of_images: float
    of_bow: float
    spread: float
    of_image: np.ndarray

    def degrees_of_freedom(self, of_images: float, of_calibration: float) -> float:
        """Return those of a sum of estimated variances (Satterthwaite 1946).

        Args:
            of_images: Degrees of freedom of the images' part.
            of_calibration: Of the calibration's part. That of the bow has as many as there are
                bows.
        """
        calibration = max(self.variance - self.of_images - self.of_bow, 0.0)
        parts = (
            (self.of_images, of_images),
            (self.of_bow, BOWS),
            (calibration, of_calibration),
        )
        return self.variance**2 / sum(part**2 / freedom for part, freedom in parts)


@dataclass
class OffsetSums:
    """Sums of products over the pixels of each image, image by image.

    Attributes:
        reference: What the calibration knows, and how its images departed from it.
        wall: What is known of the wall.
    """

    reference: Reference
    wall: Wall
    _products: list[Tensor] = field(default_factory=list)
    _count: list[int] = field(default_factory=list)
    _shared_walls: int = 0
    _correlation: Correlation = field(default_factory=Correlation)

    def __post_init__(self) -> None:
        """Standardise what the calibration left unknown."""
        known = self.reference
        within = known.covariance_within if self.wall == "per_image" else None
        self._factor = _factor(known.covariance if within is None else within)

    def add(self, image: CorrectedImage) -> None:
        """Add an image: offset, shared wall, its bow, calibration, own wall, residual."""
        linear, shared = image.linear, [] if image.shared_wall is None else [image.shared_wall]
        residual = linear.residual - linear.unknowns @ self.reference.mean
        known = [
            math.sqrt(self.reference.bow_variance) * linear.shapes[:, :BOWS],
            linear.unknowns @ self._factor,
        ]
        own = [linear.moves, linear.shapes, residual[:, None]]
        columns = torch.cat([linear.gain[:, None], *shared, *known, *own], dim=1)
        weight = pixel_weights(self.reference.noise, linear)
        self._correlation.add(linear, weight)
        self._products.append(columns.T @ (weight[:, None] * columns))
        self._count.append(len(residual))
        self._shared_walls = 3 * len(shared)

    def estimate(self) -> Offset:
        """Return the offset of all images with its standard error.

        Images may depart from each other more, or less, than those of the calibration did: their
        variances are scaled by the spread seen in both together, or in these alone where the two
        surely differ.
        """
        reference, count = self.reference, len(self._count)
        sums = GroupSums(
            torch.stack(self._products),
            torch.tensor(self._count).double(),
            len(reference.random_variance),
        )
        noise = self._noise(sums)
        precision = 1 / reference.random_variance
        if self.wall == "per_image":
            precision[:3] = 0.0
        first = self._solve(sums, noise, precision)
        # Whatever its wall, the images of the calibration departed by so much.
        usual = reference.scatter if self.wall == "per_image" else 1.0
        # Images that are alike count as fewer, and depart less from their mean.
        alike = min(repeated(reference.persistence, count), float(count))
        own = count / alike - 1
        seen = first.spread * (count - 1) / (count - alike) if own > 0 else usual
        known = max(reference.independent_poses - 1, 0.0)
        disagrees = own > 0 and known > 0 and f_tail(seen / usual, own, known) < _DISAGREES
        known = 0.0 if disagrees else known
        of_both = own + known
        spread = (known * usual + own * seen) / of_both if of_both > 0 else usual
        found = self._solve(sums, noise * spread, precision / spread / alike)
        calibration = max(reference.independent_poses - 1, 1.0)
        freedom = found.degrees_of_freedom(max(of_both, 1.0), calibration)
        return Offset(
            value=found.value,
            half_width=student_quantile((1 + _LEVEL) / 2, freedom) * math.sqrt(found.variance),
            of_image=found.of_image,
            disagreement=math.sqrt(first.spread / usual),
            disagrees=disagrees,
        )

    def _noise(self, sums: GroupSums) -> Tensor:
        """Return the variance of a pixel of weight 1 in each image, as if pixels were independent.

        Pixels that are alike count as fewer, which is as if each were as much noisier.
        """
        return own_noise(sums) * self._correlation.design_effect()

    def _solve(self, sums: GroupSums, noise: Tensor, pose_precision: Tensor) -> _Solution:
        images = reduced(sums, noise, pose_precision)
        prior = torch.ones(sums.unknowns, dtype=torch.float64)
        few = 1 + self._shared_walls
        prior[:few] = _ANYWHERE**-2
        prior[0] = 0.0
        precision = images.precision.sum(dim=0) + prior.diag()
        covariance = inverse(precision)
        solution = covariance @ images.right.sum(dim=0)
        of_images, with_bow = (
            float(inverse(precision[:size, :size])[0, 0]) for size in (few, few + BOWS)
        )
        scores = (images.right - images.precision @ solution)[:, 0]
        return _Solution(
            value=float(solution[0]),
            variance=float(covariance[0, 0]),
            of_images=of_images,
            of_bow=with_bow - of_images,
            spread=_spread(scores, images),
            of_image=(solution[0] + scores / images.precision[:, 0, 0]).numpy(),
        )


def _factor(covariance: Tensor) -> Tensor:
    """Return F with F F^T the covariance, also where that is singular."""
    scale = covariance.diagonal().clamp(min=1e-300).sqrt()
    values, vectors = torch.linalg.eigh(covariance / scale[:, None] / scale[None, :])
    return scale[:, None] * vectors * values.clamp(min=0).sqrt()


def _spread(scores: Tensor, images: Reduced) -> float:
    """Return the mean square of the images' scores over what was expected; 1 for one image."""
    count = len(scores)
    expected = images.precision[:, 0, 0]
    return float((scores.square() / expected).sum() / (count - 1)) if count > 1 else 1.0
