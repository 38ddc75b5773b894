"""The images of a board, however they are stored."""

from pathlib import Path
from typing import Protocol

import numpy as np

from tofcorr.geometry.camera import CameraIntrinsics
from tofcorr.importing.checkerboard.images import read_counts, size_text
from tofcorr.importing.checkerboard.options import CheckerboardOptions
from tofcorr.importing.checkerboard.pairs import ImagePair, find_pairs
from tofcorr.importing.report import Refusal, RefusedViewError


class BoardImages(Protocol):
    """Pairs of a depth image and an image that shows the board's corners."""

    def pairs(self) -> tuple[list[ImagePair], list[Refusal]]:
        """Return the pairs, and the images without their partner.

        Raises:
            CalibrationDataError: There are none.
        """
        ...

    def with_corners(self, pair: ImagePair) -> np.ndarray:
        """Return the image that shows the corners, shape (H, W).

        Raises:
            RefusedViewError: It cannot be used.
        """
        ...

    def measured(
        self, pair: ImagePair, camera: CameraIntrinsics
    ) -> tuple[np.ndarray, np.ndarray | None]:
        """Return depth in metres (NaN: no return) and amplitude, each of shape (H, W).

        Raises:
            RefusedViewError: An image cannot be used, or has another size than the camera.
        """
        ...


class CountImages:
    """Depth and infrared images as PNG of 16 bits; the corners are found in the infrared image.

    Args:
        folder: Where they are.
        options: Their names, and the unit of depth.
    """

    def __init__(self, folder: Path, options: CheckerboardOptions) -> None:
        self._folder, self._options = folder, options

    def pairs(self) -> tuple[list[ImagePair], list[Refusal]]:
        """Return the pairs, and the images without their partner."""
        options = self._options
        return find_pairs(self._folder, options.depth_pattern, options.infrared_pattern)

    def with_corners(self, pair: ImagePair) -> np.ndarray:
        """Return infrared counts, shape (H, W)."""
        return read_counts(pair.infrared)

    def measured(
        self, pair: ImagePair, camera: CameraIntrinsics
    ) -> tuple[np.ndarray, np.ndarray | None]:
        """Return depth in metres and infrared counts, each of shape (H, W)."""
        depth, infrared = read_counts(pair.depth), read_counts(pair.infrared)
        refuse_other_sizes(((pair.infrared, infrared), (pair.depth, depth)), camera)
        return np.where(depth > 0, depth * self._options.depth_unit, np.nan), infrared


def refuse_other_sizes(
    images: tuple[tuple[Path, np.ndarray], ...], camera: CameraIntrinsics
) -> None:
    """Refuse images of another size than the camera's.

    Raises:
        RefusedViewError: One has another size; the message names its file.
    """
    for path, image in images:
        if image.shape != (camera.height, camera.width):
            raise RefusedViewError(
                f"{path.name} has {size_text(image.shape)} pixels, the other images have "
                f"{camera.width}x{camera.height}"
            )
