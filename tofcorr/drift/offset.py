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
from dataclasses import replace
from typing import Literal, NamedTuple

import torch
from torch import Tensor

from tofcorr.correction.state import CalibrationState
from tofcorr.data.recording import FrameBatch
from tofcorr.error_terms.model import ErrorModel
from tofcorr.estimation.linear import Curvature, GroupSums, inverse, reduced
from tofcorr.estimation.robust import LEVEL, f_tail, student_quantile
from tofcorr.fit.linear_image import BOWS, linearised, wall_moves
from tofcorr.fit.reference import ImageSums, Reference, own_noise, repeated
from tofcorr.geometry.rays import plane_in_frame
from tofcorr.pixels.dataset import Dataset
from tofcorr.pixels.masks import image_planes, off_the_wall, some_pixels
from tofcorr.pixels.sample import pixels_of_image
from tofcorr.plausibility.finding import FEWEST_PIXELS

Wall = Literal["per_image", "one", "recorded"]
"""What is known of the wall: nothing; that all images show one wall; its recorded plane."""


class ImageDrift(NamedTuple):
    """One image of a drift check.

    Attributes:
        frame: Its number.
        flatness: Root mean square departure of its corrected wall from a plane, metres.
        num_pixels: Pixels used.
    """

    frame: int
    flatness: float
    num_pixels: int


class OffsetSums:
    """Sums of products over the pixels of each image, image by image.

    Args:
        state: The calibration.
        dataset: The images.
        wall: What is known of the wall.
        reference: What the calibration knows, and how its images departed from it.

    Attributes:
        sums: Of the images read so far: the offset, the shared wall, its bow, the calibration.
        images: How flat the wall of each is.
        on_wall: Pixels on the wall that their image shows.
        calibrated: Those of them within the calibrated ranges, which alone are used.
    """

    def __init__(
        self, state: CalibrationState, dataset: Dataset, wall: Wall, reference: Reference
    ) -> None:
        self._state, self._dataset, self._wall, self._reference = state, dataset, wall, reference
        self._shared_walls = 3 if wall == "one" else 0
        within = reference.covariance_within if wall == "per_image" else None
        # Standardises what the calibration left unknown.
        self._factor = Curvature(reference.covariance if within is None else within).root
        self.sums = ImageSums(reference.noise)
        self.on_wall = self.calibrated = 0
        self.images: list[ImageDrift] = []

    def read(self) -> Iterator[int]:
        """Correct the images and add those with enough usable pixels; yield their numbers."""
        rays, error = self._dataset.ray_directions(), self._state.model().error
        domain, known = self._state.domain, self._reference
        twist = self._state.hand_eye_estimated
        # Without a robot the recorded planes are in the camera's own coordinates.
        fixed = torch.eye(4, dtype=torch.float64)
        hand_eye = self._state.tool_from_camera if self._dataset.moves else fixed
        poses = self._dataset.column("world_from_tool")
        for batch in self._dataset.batches():
            on_wall = batch.valid & ~off_the_wall(batch, rays)
            inside = on_wall & domain.holds(batch.radial_distance, batch.amplitude)
            self.on_wall += int(on_wall.sum())
            self.calibrated += int(inside.sum())
            corrected = _corrected(error, batch, inside)
            planes = image_planes(corrected, rays, None)
            size = planes.norm(dim=1).clamp(min=torch.finfo(planes.dtype).tiny)
            for k, frame in enumerate(batch.indices.tolist()):
                used = inside[k].flatten().nonzero()[:, 0]
                if len(used) < FEWEST_PIXELS:
                    continue
                plane = shown = -planes[k] / size[k], 1 / size[k]
                if self._wall != "per_image":
                    plane = plane_in_frame(batch.normal_tool[k], batch.offset_tool[k], hand_eye)
                some = some_pixels(used, 5_000, frame)
                pixels, ray = pixels_of_image(batch, k, some), rays.flatten(0, 1)[some]
                image = linearised(error, pixels, ray, plane, shown, twist=twist, domain=domain)
                pose = poses[frame] @ hand_eye
                one = [wall_moves(image.points, plane[0], pose)] if self._wall == "one" else []
                bow = math.sqrt(known.bow_variance) * image.shapes[:, :BOWS]
                left = image.residual - image.unknowns @ known.mean
                self.sums.add(frame, image, [*one, bow, image.unknowns @ self._factor], left)
                distance = corrected.radial_distance[k].flatten()[used]
                points = rays.flatten(0, 1)[used] * distance[:, None]
                flatness = _departure_from_plane(points, shown, used, rays.shape[1])
                self.images.append(ImageDrift(frame, flatness, len(used)))
                yield frame

    def estimate(self) -> tuple[float, float, float | None]:
        """Return the offset along the ray; positive where the camera reads too far.

        Images may depart from each other more, or less, than those of the calibration did: their
        variances are scaled by the spread seen in both together, or in these alone where the two
        surely differ.

        Returns:
            The offset of all images and half its 95 % interval, metres; and by how much the images
            depart from each other, as a standard deviation over that of the calibration's. None:
            no more than images of one camera, one robot and flat walls may.
        """
        reference, count, sums = self._reference, len(self.sums), self.sums.groups
        # Pixels that are alike count as fewer, which is as if each were as much noisier.
        noise = own_noise(sums) * self.sums.design_effect
        precision = 1 / reference.random_variance
        if self._wall == "per_image":
            precision[:3] = 0.0
        scores, expected, *_ = self._solved(sums, noise, precision)
        spread = float((scores.square() / expected).sum() / (count - 1)) if count > 1 else 1.0
        # Whatever its wall, the images of the calibration departed by so much.
        usual = reference.scatter if self._wall == "per_image" else 1.0
        disagreement = math.sqrt(spread / usual)
        # Images that are alike count as fewer, and depart less from their mean.
        alike = min(repeated(reference.persistence, count), float(count))
        own = count / alike - 1
        seen = spread * (count - 1) / (count - alike) if own > 0 else usual
        known = max(reference.independent_poses - 1, 0.0)
        # One false headline in a thousand checks.
        disagrees = own > 0 and known > 0 and f_tail(seen / usual, own, known) < 1 / 1000
        known = 0.0 if disagrees else known
        of_both = own + known
        spread = (known * usual + own * seen) / of_both if of_both > 0 else usual
        *_, value, precision = self._solved(sums, noise * spread, precision / spread / alike)
        few = 1 + self._shared_walls
        # If the calibration were exact and the wall had no bow; with the bow; and with both.
        of_images, with_bow, variance = (
            float(inverse(precision[:size, :size])[0, 0])
            for size in (few, few + BOWS, len(precision))
        )
        # The degrees of freedom of a sum of estimated variances (Satterthwaite 1946).
        parts = (
            (of_images, max(of_both, 1.0)),
            (with_bow - of_images, BOWS),
            (max(variance - with_bow, 0.0), max(reference.independent_poses - 1, 1.0)),
        )
        freedom = variance**2 / sum(part**2 / own for part, own in parts)
        half_width = student_quantile(1 - LEVEL / 2, freedom) * math.sqrt(variance)
        return value, half_width, disagreement if disagrees else None

    def _solved(
        self, sums: GroupSums, noise: Tensor, pose_precision: Tensor
    ) -> tuple[Tensor, Tensor, float, Tensor]:
        """Solve for the offset with given variances.

        Returns:
            Each image's score and information of the offset, shape (N,), the offset, metres, and
            the precision of all that the images share.
        """
        each, right = reduced(sums, noise, pose_precision)
        prior = torch.ones(sums.unknowns, dtype=torch.float64)
        # A wall shared by all images is placed by them alone: its prior is 10 metres or radians.
        prior[: 1 + self._shared_walls] = 10.0**-2
        prior[0] = 0.0
        precision = each.sum(dim=0) + prior.diag()
        solution = inverse(precision) @ right.sum(dim=0)
        return (right - each @ solution)[:, 0], each[:, 0, 0], float(solution[0]), precision


def _corrected(error: ErrorModel, batch: FrameBatch, inside: Tensor) -> FrameBatch:
    """Return the batch with corrected distances, valid where `inside`."""
    distance = batch.radial_distance.clone()
    for k in range(len(distance)):
        used = inside[k].flatten().nonzero()[:, 0]
        flat = distance[k].flatten()
        flat[used] -= error.error_at(pixels_of_image(batch, k, used))
        distance[k] = flat.view(distance.shape[1:])
    return replace(batch, radial_distance=distance, valid=inside)


def _departure_from_plane(
    points: Tensor, plane: tuple[Tensor, Tensor], used: Tensor, width: int
) -> float:
    """Return the root mean square departure of a corrected wall from a plane, metres.

    Means over blocks of pixels are compared with the best plane; the variance that noise gives to
    such means is subtracted, so that noise alone gives about zero. Without a block of enough
    pixels: zero.

    Args:
        points: Corrected points in the camera frame, shape (M, 3), metres.
        plane: The wall that the image shows: unit normal (3,) and offset, metres.
        used: Numbers of the pixels, counted row by row, shape (M,).
        width: Of the image.
    """
    normal, offset = plane
    q = torch.linalg.qr(wall_moves(points, normal)).Q
    residual = points @ normal + offset
    residual = residual - q @ (q.T @ residual)
    # 64 pixels reduce the noise of a mean to an eighth; bends are much wider than 8.
    block = (used // width // 8) * width + used % width // 8
    place, count = torch.unique(block, return_inverse=True, return_counts=True)[1:]
    none = torch.zeros(len(count)).to(residual)
    mean = none.index_add(0, place, residual) / count
    squares = none.index_add(0, place, (residual - mean[place]).square())
    # With fewer pixels the block's own variance, which is subtracted, is hardly known.
    enough = count >= 4
    if not bool(enough.any()):
        return 0.0
    variance_of_mean = (squares / (count - 1) / count)[enough]
    return math.sqrt(max(float((mean[enough].square() - variance_of_mean).mean()), 0.0))
