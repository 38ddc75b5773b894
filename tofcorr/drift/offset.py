r"""By how much a camera reads too far, and how flat walls are, from corrected images of walls.

A camera that has drifted reads too far by some :math:`\delta` along every ray. After correction
the distance of a pixel to its wall is then

.. math:: r_v = g_v \delta + \text{(what the wall's unknown place explains)} + \text{noise},
    \quad g_v = n \cdot a_v

with the wall's normal n towards the camera and the unit ray :math:`a_v`. The residuals are linear
in the offset :math:`\delta`, in what the calibration left unknown (with the mean and covariance of
its `Reference`), in the wall's place, and in an error of the robot's pose for each image. All are
estimated together by generalised least squares, so the interval of the offset holds the uncertainty
of the calibration, of its form, of the poses and of the pixels' noise.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from typing import Literal, NamedTuple

import numpy as np
import torch
from torch import Tensor

from tofcorr.correction.state import CalibrationState
from tofcorr.data.recording import FrameBatch
from tofcorr.error_terms.model import ErrorModel
from tofcorr.estimation.linear import Curvature, GroupSums, inverse, reduced
from tofcorr.estimation.robust import f_tail, student_quantile
from tofcorr.fit.linear_image import (
    BOWS,
    Correlation,
    FormFunctions,
    LinearImage,
    Linearisation,
    wall_moves,
)
from tofcorr.fit.reference import Reference, own_noise, pixel_weights, repeated
from tofcorr.geometry.rays import plane_in_frame
from tofcorr.pixels.dataset import Dataset
from tofcorr.pixels.masks import image_planes, off_the_wall, some_pixels
from tofcorr.pixels.sample import pixels_of_image

Wall = Literal["per_image", "one", "recorded"]
"""What is known of the wall: nothing; that all images show one wall; its recorded plane."""

FEWEST_PIXELS = 50
"""Usable pixels below which an image is not used. Its wall alone has three unknowns; fifty pixels
determine them with room to spare. Set by hand, of no influence on whole images."""


class CorrectedImage(NamedTuple):
    """One image after correction: M usable pixels on its wall.

    Attributes:
        frame: Its global number.
        points: Corrected points in the camera frame, shape (M, 3), metres.
        plane: The wall that the image shows: unit normal (3,) and offset, metres.
        block: Number of the block of the image that each pixel lies in, shape (M,).
        linear: Residuals of S of the pixels to the assumed wall, and what changes them.
        shared_wall: Change of these by two turns and a shift of the wall in world axes, shape
            (S, 3), where all images share one wall; None elsewhere.
    """

    frame: int
    points: Tensor
    plane: tuple[Tensor, Tensor]
    block: Tensor
    linear: LinearImage
    shared_wall: Tensor | None


@dataclass
class PixelCount:
    """How many pixels were met.

    Attributes:
        on_wall: Pixels on the wall that their image shows.
        calibrated: Those of them within the calibrated ranges, which alone are used.
    """

    on_wall: int = 0
    calibrated: int = 0

    @property
    def share_outside(self) -> float:
        """Share of the pixels on walls that lie outside the calibrated ranges."""
        return 1 - self.calibrated / max(self.on_wall, 1)


def corrected_images(
    state: CalibrationState, dataset: Dataset, wall: Wall, count: PixelCount
) -> Iterator[CorrectedImage]:
    """Correct the images that have enough usable pixels.

    Args:
        state: The calibration.
        dataset: The images.
        wall: What is known of the wall.
        count: Adds up the pixels of all images, also of those not returned.
    """
    rays = dataset.ray_directions()
    width = rays.shape[1]
    model, off_wall = state.model(), off_the_wall(rays)
    linear = Linearisation(
        model.error, FormFunctions(state.domain), rays, twist=state.hand_eye_estimated
    )
    # Without a robot the recorded planes are in the camera's own coordinates.
    hand_eye = state.tool_from_camera if dataset.moves else torch.eye(4, dtype=torch.float64)
    poses = torch.cat(
        [torch.from_numpy(recording.frames.world_from_tool) for recording in dataset.recordings]
    )
    for batch in dataset.batches():
        on_wall = batch.valid & ~off_wall(batch)
        inside = on_wall & state.domain.holds(batch.radial_distance, batch.amplitude)
        count.on_wall += int(on_wall.sum())
        count.calibrated += int(inside.sum())
        corrected = _corrected(model.error, batch, inside)
        planes = image_planes(corrected, rays, None)
        size = planes.norm(dim=1).clamp(min=1e-12)
        for k, frame in enumerate(batch.indices.tolist()):
            used = inside[k].flatten().nonzero()[:, 0]
            if len(used) < FEWEST_PIXELS:
                continue
            plane = shown = -planes[k] / size[k], 1 / size[k]
            if wall != "per_image":
                plane = plane_in_frame(batch.normal_tool[k], batch.offset_tool[k], hand_eye)
            image = linear(batch, k, some_pixels(used, 5_000, frame), plane, shown)
            shared = None
            if wall == "one":
                shared = wall_moves(image.points, plane[0], poses[frame] @ hand_eye)
            distance = corrected.radial_distance[k].flatten()[used]
            yield CorrectedImage(
                frame=frame,
                points=rays.flatten(0, 1)[used] * distance[:, None],
                plane=shown,
                # 64 pixels reduce the noise of a mean to an eighth; bends are much wider than 8.
                block=(used // width // 8) * width + used % width // 8,
                linear=image,
                shared_wall=shared,
            )


def _corrected(error: ErrorModel, batch: FrameBatch, inside: Tensor) -> FrameBatch:
    """Return the batch with corrected distances, valid where `inside`."""
    distance = batch.radial_distance.clone()
    for k in range(len(distance)):
        used = inside[k].flatten().nonzero()[:, 0]
        flat = distance[k].flatten()
        flat[used] -= error.error_at(pixels_of_image(batch, k, used))
        distance[k] = flat.view(distance.shape[1:])
    return replace(batch, radial_distance=distance, valid=inside)


def departure_from_plane(image: CorrectedImage) -> float:
    """Return the root mean square departure of the corrected wall from a plane, metres.

    Means over blocks of pixels are compared with the best plane; the variance that noise gives to
    such means is subtracted, so that noise alone gives about zero. Without a block of enough
    pixels: zero.
    """
    normal, offset = image.plane
    q = torch.linalg.qr(wall_moves(image.points, normal)).Q
    residual = image.points @ normal + offset
    residual = residual - q @ (q.T @ residual)
    blocks, place = torch.unique(image.block, return_inverse=True)
    count = torch.bincount(place, minlength=len(blocks)).to(residual)
    mean = torch.zeros(len(blocks)).to(residual).index_add_(0, place, residual) / count
    squares = (residual - mean[place]).square()
    within = torch.zeros(len(blocks)).to(residual).index_add_(0, place, squares)
    # With fewer pixels the block's own variance, which is subtracted, is hardly known.
    enough = count >= 4
    if not bool(enough.any()):
        return 0.0
    variance_of_mean = within[enough] / (count[enough] - 1) / count[enough]
    return math.sqrt(max(float((mean[enough].square() - variance_of_mean).mean()), 0.0))


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
        self._factor = Curvature(known.covariance if within is None else within).root

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
        # One false headline in a thousand checks.
        disagrees = own > 0 and known > 0 and f_tail(seen / usual, own, known) < 1e-3
        known = 0.0 if disagrees else known
        of_both = own + known
        spread = (known * usual + own * seen) / of_both if of_both > 0 else usual
        found = self._solve(sums, noise * spread, precision / spread / alike)
        calibration = max(reference.independent_poses - 1, 1.0)
        freedom = found.degrees_of_freedom(max(of_both, 1.0), calibration)
        return Offset(
            value=found.value,
            half_width=student_quantile(0.975, freedom) * math.sqrt(found.variance),
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
        each, right = reduced(sums, noise, pose_precision)
        prior = torch.ones(sums.unknowns, dtype=torch.float64)
        few = 1 + self._shared_walls
        # A wall shared by all images is placed by them alone: its prior is 10 metres or radians.
        prior[:few] = 10.0**-2
        prior[0] = 0.0
        precision = each.sum(dim=0) + prior.diag()
        covariance = inverse(precision)
        solution = covariance @ right.sum(dim=0)
        of_images, with_bow = (
            float(inverse(precision[:size, :size])[0, 0]) for size in (few, few + BOWS)
        )
        scores, expected = (right - each @ solution)[:, 0], each[:, 0, 0]
        return _Solution(
            value=float(solution[0]),
            variance=float(covariance[0, 0]),
            of_images=of_images,
            of_bow=with_bow - of_images,
            spread=_spread(scores, expected),
            of_image=(solution[0] + scores / expected).numpy(),
        )


def _spread(scores: Tensor, expected: Tensor) -> float:
    """Return the mean square of the images' scores over what was expected; 1 for one image."""
    count = len(scores)
    return float((scores.square() / expected).sum() / (count - 1)) if count > 1 else 1.0
