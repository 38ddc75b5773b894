"""A corrector read from a file of any format, called in one way."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from tofcorr.correction.corrector import check_frames
from tofcorr.correction.metadata import CorrectorMetadata
from tofcorr.correction.model import required_amplitude
from tofcorr.errors import CalibrationDataError, FrameError

Correct = Callable[[Tensor, Tensor], tuple[Tensor, Tensor]]
"""Takes depth and amplitude and returns corrected depth and where it is valid."""


class LoadedCorrector(nn.Module):
    """What `tofcorr.load_corrector` returns: `corrected, valid = corrector(depth, amplitude)`.

    Args:
        correct: What corrects frames in float32; a module among the submodules, so that `to` moves
            it. Others return their results on the device of the frames.
        metadata: Returns what it says of itself, JSON text.
        path: Of the file, for messages.

    Raises:
        CalibrationDataError: It says nothing of itself, or what no corrector says.

    Attributes:
        known: What is read of its metadata.

    Shape:
        - Input: `(H, W)` or `(B, H, W)` twice, float32: metres, and the camera's amplitude units.
        - Output: the same shape, float32 metres; the same shape, bool. See `DepthCorrector`.
    """

    def __init__(self, correct: Correct, metadata: Callable[[], str], path: Path | str) -> None:
        super().__init__()
        self.correct: Any = correct
        try:
            self.text = metadata()
            said = json.loads(self.text)
        except (AttributeError, TypeError, ValueError, RuntimeError, RecursionError):
            expected = "expected a file of tofcorr train or export"
            why = f"{path}: without a corrector's metadata; {expected}."
            raise CalibrationDataError(why) from None
        self.known = CorrectorMetadata.from_mapping(said, f"{path}, metadata", CalibrationDataError)
        self.eval()

    def forward(
        self,
        depth: Any,  # noqa: ANN401 - tensors, or arrays
        amplitude: Any = None,  # noqa: ANN401
        **conditions: float,
    ) -> tuple[Any, Any]:
        """Return corrected depth, metres, and where it is valid: tensors of tensors, else arrays.

        Args:
            depth: Of the camera's kind, metres, float32.
            amplitude: The camera's units, float32; None where no term of the model needs it.
            **conditions: Of these frames, as `DepthCorrector.set_conditions` takes them. What is
                not given is the mean of the calibration.

        Raises:
            ValueError: Shape or dtype are not those of the camera, amplitudes are missing, or the
                format holds the mean conditions alone (a `FrameError`).
        """
        if isinstance(depth, np.ndarray):
            given = None if amplitude is None else torch.tensor(amplitude)
            return tuple(one.numpy() for one in self(torch.tensor(depth), given, **conditions))
        if amplitude is None and not self.known.needs_amplitude:
            amplitude = torch.zeros_like(depth)
        strength = required_amplitude(amplitude)
        camera = self.known.camera
        size = camera.height or depth.shape[-2], camera.width or depth.shape[-1]
        check_frames(depth, strength, *size)
        if hasattr(self.correct, "set_conditions"):
            self.correct.set_conditions(**conditions)
        elif conditions:
            held = "it holds the mean conditions of its calibration: load the run, or its .ts"
            raise FrameError(f"{', '.join(conditions)}: this file cannot take it, {held}.")
        return self.correct(depth, strength)

    def set_pose(self, world_from_tool: Any) -> None:  # noqa: ANN401 - tensor, or array
        """Set the tool's pose in the next frames, as `DepthCorrector.set_pose` does."""
        if hasattr(self.correct, "set_pose"):
            self.correct.set_pose(torch.as_tensor(world_from_tool))

    def metadata(self) -> str:
        """Return camera, model, validity range and versions as JSON text."""
        return self.text
