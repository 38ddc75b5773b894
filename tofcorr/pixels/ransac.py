"""Finds the wall in each image where no mask was recorded: the largest plane, by RANSAC."""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from tofcorr.data.frames import FrameBatch
from tofcorr.pixels.walls import ENOUGH_FOR_MASKS, image_planes

# Triples of pixels drawn in each image. With a third of the pixels on the wall, 300 triples all
# miss it with probability (1 - 1/27)^300 = 1e-5.
_TRIPLES = 300
# Pixels of the image, at most, on which the planes of the triples are compared. Set by hand.
_JUDGES = 2000
# Fits of a plane to the pixels near the previous one. Set by hand.
_REFINEMENTS = 3


@dataclass(frozen=True)
class NotOnLargestPlane:
    """Finds pixels that are not on the largest plane of their image (Fischler and Bolles 1981).

    The same image always gives the same result: the frame's number seeds the random triples.

    Attributes:
        ray_directions: Unit rays, shape (H, W, 3).
        tolerance: How far a pixel's distance may be from the plane's, metres. It must leave room
            for the camera's error across the image, which is what is to be calibrated.
    """

    ray_directions: Float[Tensor, "H W 3"]
    tolerance: float

    def __call__(self, batch: FrameBatch) -> Bool[Tensor, "B H W"]:
        """Return True where a pixel is not on the wall, shape (B, H, W)."""
        rays = self.ray_directions.to(batch.radial_distance)
        near = torch.zeros_like(batch.valid)
        for k, frame in enumerate(batch.indices.tolist()):
            near[k] = self._near(batch.radial_distance[k], batch.valid[k], rays, frame)
        # The camera's error bends the measured wall: a plane fitted to much of it is better
        # than that of three pixels.
        for _ in range(_REFINEMENTS):
            planes = image_planes(replace(batch, valid=near), rays, ENOUGH_FOR_MASKS)
            fitted = -planes.offset[:, None, None] / torch.einsum(
                "hwa,ba->bhw", rays, planes.normal
            )
            near = batch.valid & ((batch.radial_distance - fitted).abs() <= self.tolerance)
        return ~near

    def _near(
        self,
        distance: Float[Tensor, "H W"],
        valid: Bool[Tensor, "H W"],
        rays: Float[Tensor, "H W 3"],
        frame: int,
    ) -> Bool[Tensor, "H W"]:
        """Return the pixels near the best triple's plane: the one with most pixels near it."""
        usable = valid.flatten().nonzero()[:, 0]
        if len(usable) < 3:
            return torch.zeros_like(valid)
        generator = torch.Generator().manual_seed(frame)
        judges = usable[torch.randperm(len(usable), generator=generator)[:_JUDGES].to(usable)]
        drawn = torch.randint(len(usable), (_TRIPLES, 3), generator=generator).to(usable)
        flat_rays, flat = rays.flatten(0, 1), distance.flatten()
        points = flat_rays[usable[drawn]] * flat[usable[drawn], None]
        normal = torch.linalg.cross(points[:, 1] - points[:, 0], points[:, 2] - points[:, 0])
        length = normal.norm(dim=1, keepdim=True)
        normal = normal / length.clamp(min=1e-12)
        offset = (normal * points[:, 0]).sum(dim=1)
        met = offset[:, None] / (normal @ flat_rays[judges].T)
        votes = ((met - flat[judges]).abs() <= self.tolerance).sum(dim=1)
        votes[length[:, 0] < 1e-9] = 0
        best = int(votes.argmax())
        met = offset[best] / (rays @ normal[best])
        return valid & ((met - distance).abs() <= self.tolerance)
