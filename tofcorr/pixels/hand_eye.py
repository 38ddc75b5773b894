"""What a data set knows of the hand-eye transform before any fit."""

from typing import Literal

import numpy as np
import torch
from torch import Tensor

from tofcorr.options import Options
from tofcorr.pixels.dataset import Dataset


class HandEyeOptions(Options):
    """What is known of the hand-eye transform.

    Attributes:
        estimate: `auto` estimates it if the tool moves, and holds the identity without a robot.
        start: `auto` needs no guess (closed form from plane normals) and also tries the
            recording's own; `recording` starts from the recording's alone.
    """

    estimate: Literal["auto", "yes", "no"] = "auto"
    start: Literal["auto", "recording"] = "auto"


def hand_eye_is_free(dataset: Dataset, options: HandEyeOptions) -> bool:
    """Whether the hand-eye transform is an unknown: only a moving tool reveals it."""
    return dataset.moves if options.estimate == "auto" else options.estimate == "yes"


def recorded_hand_eye(dataset: Dataset) -> Tensor:
    """Return tool_from_camera as the recording has it; the identity without a robot."""
    if not dataset.moves:
        return torch.eye(4, dtype=torch.float64)
    return torch.from_numpy(np.asarray(dataset.first.tool_from_camera, dtype=np.float64)).clone()
