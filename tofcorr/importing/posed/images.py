"""Depth images of a source as distances along the ray, and their planes."""

import numpy as np
import torch
from torch import Tensor

from tofcorr.errors import CalibrationDataError
from tofcorr.geometry.rays import ray_directions
from tofcorr.importing.posed.options import PosedOptions
from tofcorr.importing.report import RefusedViewError
from tofcorr.importing.source import DepthImage, DepthSource
from tofcorr.importing.walls.finding import planes_of_image
from tofcorr.importing.walls.image_plane import ImagePlane


class RadialImages:
    """Reads the images of a source one at a time; the last one is kept, and the planes of all.

    Args:
        source: The images; each was read before without being refused.
        options: What depth means, which amplitudes are saturated, and how planes are found.
        named: Whether each image shows one wall and nothing else.

    Attributes:
        source: The images.
        rays: Unit viewing rays, shape (H, W, 3).
    """

    def __init__(self, source: DepthSource, options: PosedOptions, *, named: bool = False) -> None:
        self.source = source
        self.rays = ray_directions(source.camera)
        self._depth_kind = options.depth_kind
        self._saturation = options.saturation_amplitude
        self._walls, self._named = options.walls, named
        self._last: tuple[int, DepthImage] | None = None
        self._planes: dict[int, list[ImagePlane]] = {}

    def read(self, number: int) -> DepthImage:
        """Return an image; the frames of its walls follow each other, so the last one is kept.

        Raises:
            CalibrationDataError: It cannot be read any more.
        """
        if self._last is None or self._last[0] != number:
            try:
                self._last = (number, self.source.read(number))
            except RefusedViewError as refusal:
                raise CalibrationDataError(
                    f"{self.source.origin}: {refusal}; it was readable at the start of the import. "
                    "Were the files changed?"
                ) from None
        return self._last[1]

    def planes(self, number: int) -> list[ImagePlane]:
        """Return the planes of an image, found once: some hundred numbers."""
        if number not in self._planes:
            self._planes[number] = self.planes_in(*self.radial(number))
        return self._planes[number]

    def planes_in(self, distance: Tensor, valid: Tensor) -> list[ImagePlane]:
        """Find the planes of an image of this camera, both (H, W)."""
        return planes_of_image(distance, valid, self.rays, self._walls, named=self._named)

    def radial(self, number: int) -> tuple[Tensor, Tensor]:
        """Return distances along the ray in metres, and where they are usable, both (H, W)."""
        return self.along_rays(self.read(number))

    def along_rays(self, image: DepthImage) -> tuple[Tensor, Tensor]:
        """Return distances along the ray in metres, and where they are usable, both (H, W)."""
        depth = torch.from_numpy(image.depth).double()
        distance = depth / self.rays[..., 2] if self._depth_kind == "z" else depth
        valid = distance.isfinite() & (distance > 0)
        if self._saturation is not None and image.amplitude is not None:
            valid &= torch.from_numpy(np.asarray(image.amplitude)) < self._saturation
        return distance.nan_to_num(0.0), valid
