"""Reading 16-bit PNG images."""

from pathlib import Path

import cv2
import numpy as np

from tofcorr.importing.report import RefusedViewError


def read_counts(path: Path) -> np.ndarray:
    """Read a 16-bit grey PNG without conversion, shape (H, W), uint16.

    Raises:
        RefusedViewError: The file cannot be read, is not an image, or does not have one channel of
            16 bits.
    """
    try:
        content = np.frombuffer(path.read_bytes(), np.uint8)
        image = cv2.imdecode(content, cv2.IMREAD_UNCHANGED) if content.size else None
    except OSError as error:
        raise RefusedViewError(f"{path.name} cannot be read ({error.strerror})") from None
    except cv2.error:
        image = None
    if image is None:
        raise RefusedViewError(f"{path.name} is not a readable image; is it truncated?")
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
