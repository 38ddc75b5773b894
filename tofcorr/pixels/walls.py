"""The plane on which most pixels of an image lie, fitted without any calibration."""

from dataclasses import dataclass
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from tofcorr.data.frames import FrameBatch
from tofcorr.estimation.statistics import robust_weights
from tofcorr.pixels.image_pixels import some_pixels
from tofcorr.spread import sigma_from_mad

# Reweighting steps of the robust fit; it has settled by then. Set by hand.
_ITERATIONS = 15
# A pixel is not on the wall if it is off by more than this many times the image's median deviation
# and by more than 50 mm: a camera's own error varies by centimetres across an image. Set by hand.
_GROSS = 15.0
_GROSS_METRES = 0.05
# Pixels of an image that its plane is fitted to where a mask only compares with it: their noise
# leaves a tenth of a millimetre, and a mask's tolerance is of centimetres. Chosen.
ENOUGH_FOR_MASKS = 4096


class ImagePlanes(NamedTuple):
    """The planes that images look at.

    Attributes:
        normal: Unit normals in the camera frame, towards the camera, shape (B, 3).
        offset: Distances of the camera from the planes, shape (B,), metres.
        deviation: Measured minus fitted distance along the ray, shape (B, H, W), metres; NaN
            where a pixel is not valid.
    """

    normal: Tensor
    offset: Tensor
    deviation: Tensor


def image_planes(
    batch: FrameBatch, ray_directions: Float[Tensor, "H W 3"], enough: int | None = None
) -> ImagePlanes:
    """Fit a plane to each image, robustly (Cauchy weights).

    On the plane n . x + d = 0 the inverse distance is linear in the ray: 1 / D = -(n . ray) / d.

    Args:
        batch: The images.
        ray_directions: Unit rays, shape (H, W, 3).
        enough: Valid pixels of an image that the fit needs; None: it takes all.
    """
    # A board covers few pixels of a large image: those that no image shows need no arithmetic.
    seen = batch.valid.flatten(1).any(dim=0)
    seen[0] = True  # Without any column there is no median.
    rays = ray_directions.to(batch.radial_distance).flatten(0, 1)[seen]
    valid = batch.valid.flatten(1)[:, seen]
    distance = torch.where(valid, batch.radial_distance.flatten(1)[:, seen], 1.0)
    step = 1 if enough is None else max(int(valid.sum(dim=1).min()) // max(enough, 1), 1)
    some = some_pixels(torch.arange(len(rays)), len(rays) // step, seed=0)
    gradient = _inverse_planes(distance[:, some], valid[:, some], rays[some])
    length = gradient.norm(dim=1, keepdim=True).clamp(min=1e-12)
    fitted = gradient @ rays.T
    deviation = torch.full(batch.valid.shape, torch.nan).to(distance)
    deviation.flatten(1)[:, seen] = torch.where(
        valid & (fitted > 0), distance - 1 / fitted, torch.nan
    )
    return ImagePlanes(-gradient / length, 1 / length[:, 0], deviation)


def _inverse_planes(
    distance: Float[Tensor, "B V"], valid: Bool[Tensor, "B V"], rays: Float[Tensor, "V 3"]
) -> Float[Tensor, "B 3"]:
    """Return g of 1 / D = g . ray of each image, fitted robustly to its valid pixels."""
    inverse = 1 / distance
    weight = valid.to(inverse)
    gradient = rays.new_zeros(len(distance), 3)
    ridge = 1e-12 * torch.eye(3).to(inverse)
    for _ in range(_ITERATIONS):
        matrix = torch.einsum("bv,va,vc->bac", weight, rays, rays)
        right = torch.einsum("bv,va->ba", weight * inverse, rays)
        gradient = torch.linalg.solve(matrix + ridge, right[:, :, None])[:, :, 0]
        # Deviations as distances, not as inverse distances: their noise is of one size.
        off = (inverse - gradient @ rays.T) * distance.square()
        among = torch.where(valid, off.abs(), torch.nan).nanmedian(dim=1, keepdim=True).values
        scale = sigma_from_mad(among).clamp(min=1e-6)
        # The factor makes a least-squares fit of inverse distances one of distances.
        weight = valid * robust_weights(off / scale, "cauchy") * distance.square().square()
        weight = weight.nan_to_num(0.0)
    return gradient


@dataclass(frozen=True)
class OffTheWall:
    """Finds pixels far off the plane of most of their image.

    Attributes:
        ray_directions: Unit rays, shape (H, W, 3).
        tolerance: Largest deviation of a pixel on the wall, metres; None: fifteen times the
            image's median deviation, but at least 50 mm.
    """

    ray_directions: Float[Tensor, "H W 3"]
    tolerance: float | None = None

    def __call__(self, batch: FrameBatch) -> Bool[Tensor, "B H W"]:
        """Return True where a pixel is not on the wall, shape (B, H, W)."""
        deviation = image_planes(batch, self.ray_directions, ENOUGH_FOR_MASKS).deviation.abs()
        if self.tolerance is not None:
            return ~(deviation <= self.tolerance)
        median = deviation.flatten(1).nanmedian(dim=1).values
        limit = (_GROSS * median).clamp(min=_GROSS_METRES)
        return ~(deviation <= limit[:, None, None])
