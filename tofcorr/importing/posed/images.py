"""Depth images of a source as distances along the ray, the last one kept."""

import numpy as np
import torch
from torch import Tensor

from tofcorr.errors import CalibrationDataError
from tofcorr.geometry.rays import ray_directions
from tofcorr.importing.posed.options import PosedOptions
from tofcorr.importing.report import RefusedViewError
from tofcorr.importing.source import DepthImage, DepthSource


class RadialImages:
    """Reads the images of a source one at a time.

    Args:
        source: The images; each was read before without being refused.
        options: What depth means, and which amplitudes are saturated.

    Attributes:
        source: The images.
        rays: Unit viewing rays, shape (H, W, 3).
    """

    def __init__(self, source: DepthSource, options: PosedOptions) -> None:
        self.source = source
        self.rays = ray_directions(source.camera)
        self._depth_kind = options.depth_kind
        self._saturation = options.saturation_amplitude
        self._last: tuple[int, DepthImage] | None = None

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
