"""The hand-eye transform before any fit: whether it is estimated, and where the fit starts."""

from typing import Literal

import numpy as np
import torch
from jaxtyping import Float
from pydantic import field_validator
from torch import Tensor

from tofcorr.options import Options
from tofcorr.pixels.dataset import Dataset


class HandEyeOptions(Options):
    """Whether the hand-eye transform is estimated, and where its estimate starts.

    Attributes:
        estimate: `auto` estimates it if the tool moves, and uses the identity without a robot;
            `yes` estimates it; `no` uses the recording's.
        start: `auto` takes the better of a closed form from plane normals and the recording's own;
            `recording` starts from the recording's.
    """

    estimate: Literal["auto", "yes", "no"] = "auto"
    start: Literal["auto", "recording"] = "auto"

    @field_validator("estimate", mode="before")
    @classmethod
    def _in_words(cls, given: object) -> object:
        """Take YAML's own reading of a bare yes or no."""
        return {True: "yes", False: "no"}[given] if isinstance(given, bool) else given


def hand_eye_is_free(dataset: Dataset, options: HandEyeOptions) -> bool:
    """Whether the hand-eye transform is estimated; `auto` does so only if the tool moves."""
    return dataset.moves if options.estimate == "auto" else options.estimate == "yes"


def recorded_hand_eye(dataset: Dataset) -> Float[Tensor, "4 4"]:
    """Return tool_from_camera as the recording has it; the identity without a robot."""
    if not dataset.moves:
        return torch.eye(4, dtype=torch.float64)
    return torch.from_numpy(np.asarray(dataset.first.tool_from_camera, dtype=np.float64)).clone()
