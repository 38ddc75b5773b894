"""Whether walls contradict a hand-eye transform that the source states."""

import math

import numpy as np
import torch

from tofcorr.geometry import se3

_FAR_MM, _FAR_DEG = 50.0, 3.0
"""A known hand-eye transform is doubted if the walls put the camera farther than this from it: a
few times what an uncalibrated camera's error moves the estimate."""


def contradiction(known: np.ndarray | None, found: np.ndarray) -> list[str]:
    """Return a sentence if the walls contradict a known hand-eye transform; else nothing.

    Args:
        known: tool_from_camera as the source states it, shape (4, 4); None: it does not.
        found: tool_from_camera under which the walls fit best, shape (4, 4).
    """
    if known is None:
        return []
    shift, turn = se3.apart(torch.as_tensor(known), torch.as_tensor(found))
    far, angle = 1e3 * shift, math.degrees(turn)
    if far < _FAR_MM and angle < _FAR_DEG:
        return []
    return [
        f"The walls fit best with the camera {far:.0f} mm and {angle:.1f} degrees away from where "
        "its poses place it. Are the poses those of the depth camera?"
    ]
