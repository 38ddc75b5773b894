"""Reading 16-bit PNG images."""

from pathlib import Path

import numpy as np

from tofcorr.importing.images.decode import read_image
from tofcorr.importing.report import RefusedViewError


def read_counts(path: Path) -> np.ndarray:
    """Read a 16-bit grey PNG without conversion, shape (H, W), uint16.

    Raises:
        RefusedViewError: The file cannot be read, is not an image, or does not have one channel of
            16 bits.
    """
    image = read_image(path)
    if image.ndim != 2:
        raise RefusedViewError(
            f"{path.name} has {image.shape[2]} channels; one grey channel of 16 bits is needed"
        )
    if image.dtype != np.uint16:
        raise RefusedViewError(
            f"{path.name} has {8 * image.itemsize} bits a pixel; 16 are needed "
            "(an 8-bit image is only a preview of depth or amplitude)"
        )
    return image


def size_text(image_shape: tuple[int, ...]) -> str:
    """Return 'WIDTHxHEIGHT'."""
    return f"{image_shape[1]}x{image_shape[0]}"
