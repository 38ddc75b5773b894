"""The border of an image: its outer eighth on each side."""

import numpy as np


def border_of(shape: tuple[int, ...]) -> np.ndarray:
    """Return True in the outer eighth of an image on each side.

    Args:
        shape: Height and width.

    Returns:
        Shape (H, W), bool.
    """
    height, width = shape
    border = np.ones((height, width), dtype=bool)
    border[height // 8 : height - height // 8, width // 8 : width - width // 8] = False
    return border
