"""A twist of the camera as plain values, in the units of reports."""

import torch
from torch import Tensor


def twist_mapping(twist: Tensor, rotation: Tensor) -> dict[str, list[float]]:
    """Return shift (mm) and turn (degrees) along the tool's axes.

    Args:
        twist: In camera axes, translation first, shape (6,), metres and radians.
        rotation: Of tool_from_camera, shape (3, 3).
    """
    return {
        "translation_mm": (1e3 * rotation @ twist[:3]).tolist(),
        "rotation_deg": torch.rad2deg(rotation @ twist[3:]).tolist(),
    }
