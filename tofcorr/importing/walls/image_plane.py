"""One plane of one depth image, in numbers."""

from typing import NamedTuple

import torch
from torch import Tensor

from tofcorr.estimation.statistics import robust_scale

# The camera's error is alike across about a third of the image each way: nine independent errors.
_INDEPENDENT = 9.0
# No plane is known better than this, metres: the error that a camera has on average anyway.
LEAST_SPREAD = 1e-3
# A plane is described from about this many of its pixels: noise of 10 mm then moves it by 0.1 mm,
# far below the error of the camera.
_MOST_PIXELS = 20_000


class ImagePlane(NamedTuple):
    """One plane of an image, in the camera frame.

    Attributes:
        normal: Unit normal towards the camera, shape (3,).
        offset: Distance of the camera from the plane, metres: normal . x + offset = 0.
        support: Pixels of the image that lie on it.
        spread: Robust standard deviation of measured minus fitted distance along the ray, metres.
        covariance: Of `-normal / offset`, shape (3, 3), per square metre. The camera's error is
            taken as alike over a ninth of the plane.
        points: Four points that have the mean and the second moments of the measured ones,
            shape (4, 3), metres: they say as much of the plane's place as all pixels.
    """

    normal: Tensor
    offset: float
    support: int
    spread: float
    covariance: Tensor
    points: Tensor

    @property
    def gradient(self) -> Tensor:
        """The vector g of the plane g . x = 1, shape (3,), per metre."""
        return -self.normal / self.offset


def described(distance: Tensor, rays: Tensor, mask: Tensor, gradient: Tensor) -> ImagePlane:
    """Describe the plane g . x = 1 that was fitted to the pixels of a mask (H, W)."""
    used = mask.flatten().nonzero()[:, 0]
    step = max(1, len(used) // (_MOST_PIXELS))
    direction = rays.flatten(0, 1)[used[::step]].to(torch.float64)
    measured = distance.flatten()[used[::step]].to(torch.float64)
    off = measured - 1 / (direction @ gradient)
    spread = max(robust_scale(off), LEAST_SPREAD)
    weighted = direction * measured[:, None].square()
    information = weighted.T @ weighted * (_INDEPENDENT / len(measured)) / spread**2
    length = float(gradient.norm())
    points = direction / (direction @ gradient)[:, None]
    return ImagePlane(
        -gradient / length,
        1 / length,
        len(used),
        spread,
        torch.linalg.pinv(information, hermitian=True),
        representative_points(points),
    )


def representative_points(points: Tensor) -> Tensor:
    """Return four points with the mean and second moments in their plane of (M, 3) points."""
    mean = points.mean(dim=0)
    centred = points - mean
    values, vectors = torch.linalg.eigh(centred.T @ centred / len(points))
    # Two pairs, each 2^(1/2) standard deviations either side of the mean: the same moments.
    arms = vectors[:, 1:] * (2 * values[1:].clamp(min=0)).sqrt()
    return torch.stack([mean + arms[:, 0], mean - arms[:, 0], mean + arms[:, 1], mean - arms[:, 1]])
