"""Distances as a camera would have measured them without second bounces of light."""

import torch
from torch import Tensor

from tofcorr.correction.corrector import DepthCorrector
from tofcorr.correction.state import CalibrationState, SceneLight
from tofcorr.data.recording import FrameBatch


class DirectDistance:
    """Takes second bounces out of measured distances, and leaves the camera's own error in them.

    That error is a function of the distance as measured, m = d + e(m). Without second bounces the
    camera measures m' = d + e(m'), so the error moves along. Each frame is computed once, and what
    is taken off is kept in half precision: to a thousandth of itself.

    Args:
        state: The calibration, with second bounces.
        poses: World from tool, one of each frame of the data set (N, 4, 4).
    """

    def __init__(self, state: CalibrationState, poses: Tensor) -> None:
        self._poses = poses @ state.tool_from_camera.cpu()
        plain = state.model_copy(update={"scene": SceneLight()})
        self._correct, self._bounces = DepthCorrector.from_state(plain), state.second_bounces()
        self._taken: dict[int, Tensor] = {}

    @torch.no_grad()
    def __call__(self, batch: FrameBatch) -> Tensor:
        """Return distances along the ray (B, H, W), metres; frames have the data set's numbers."""
        assert batch.amplitude is not None
        for frame, *images in zip(
            batch.indices.tolist(), batch.radial_distance, batch.amplitude, strict=True
        ):
            if frame not in self._taken:
                own = (image.float().cpu() for image in images)
                self._taken[frame] = self._off(self._poses[frame], *own).half()
        taken = torch.stack([self._taken[frame] for frame in batch.indices.tolist()])
        return batch.radial_distance - taken.to(batch.radial_distance)

    def _off(self, pose: Tensor, radial: Tensor, light: Tensor) -> Tensor:
        """Return what is taken off one frame (H, W), metres; 0 without a return."""
        assert self._bounces is not None
        self._bounces.room.set_pose(pose)
        corrected = self._corrected(radial, light)
        direct = self._bounces(corrected, light)
        without = radial - corrected + direct
        # Once is enough: an error changes by some percent of the distance's change.
        without = direct + (without - self._corrected(without, light))
        return (radial - without).nan_to_num()

    def _corrected(self, radial: Tensor, light: Tensor) -> Tensor:
        scale = self._correct.radial_of_z
        return self._correct(radial / scale, light)[0] * scale
