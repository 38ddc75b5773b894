"""The correction of frames as an `nn.Module`: what it computes, without fitting and files."""

import torch
from torch import Tensor

from tofcorr.correction.hand_eye import HandEye
from tofcorr.data.frames import FrameBatch
from tofcorr.error_terms.base import DescribedModule
from tofcorr.error_terms.given_conditions import Condition, in_si_units, with_means
from tofcorr.error_terms.model import ErrorModel
from tofcorr.geometry.se3 import transformed
from tofcorr.module import correcting, loss
from tofcorr.module.geometry import CameraGeometry
from tofcorr.module.ranges import CalibratedRanges


class FrameCorrection(DescribedModule):
    r"""Corrects frames, differentiable in depth, amplitude and every parameter.

    .. math:: D_\mathrm{corrected} = D - E(D, I, r, c, \text{conditions})

    Attributes:
        error_model: The terms and the residual network, which predict the error E.
        hand_eye: tool_from_camera, as a twist around a starting transform.
        geometry: The camera, as buffers.
        ranges: The calibrated ranges, as buffers.
    """

    error_model: ErrorModel
    hand_eye: HandEye
    geometry: CameraGeometry
    ranges: CalibratedRanges

    def forward(
        self, depth: Tensor, amplitude: Tensor | None = None, **conditions: Condition
    ) -> Tensor:
        """Return corrected depth.

        Args:
            depth: Of the camera's `depth_kind`, shape (..., H, W), metres.
            amplitude: The camera's units, the shape of `depth`; None where no term needs it.
            **conditions: `timestamp_s`, `integration_time_us`, `room_temperature_c`,
                `body_temperature_c`, `ambient`: one number, or one for each frame (...). What is
                not given is taken as the mean of the calibration.

        Returns:
            A new tensor of the shape and dtype of `depth`, metres; NaN where there is no return.

        Raises:
            FrameError: The frames are of another size or dtype, or amplitudes are missing.
        """
        error, seen = self._error(depth, amplitude, conditions)
        corrected = depth.to(error.dtype) - error
        return torch.where(seen, corrected, torch.nan).to(depth.dtype)

    def error(
        self, depth: Tensor, amplitude: Tensor | None = None, **conditions: Condition
    ) -> Tensor:
        """Return the predicted error, measured - true: depth - error is the corrected depth.

        Arguments, shape and dtype are those of `forward`.
        """
        error, seen = self._error(depth, amplitude, conditions)
        return torch.where(seen, error, torch.nan).to(depth.dtype)

    def valid(
        self, depth: Tensor, amplitude: Tensor | None = None, **conditions: Condition
    ) -> Tensor:
        """Return where the correction is valid, bool, the shape of `depth`.

        Not valid is a pixel without a return, a saturated one, and one whose distance, amplitude
        or conditions are outside the calibrated range. The rule is that of `corrector.ts`.
        """
        self.geometry.check(depth, amplitude)
        given = correcting.measured(depth, amplitude, self.error_model, self.geometry, self.ranges)
        known = self._conditions(depth, conditions)
        return correcting.valid_pixels(given, amplitude, known, self.error_model, self.ranges)

    def points(
        self, depth: Tensor, amplitude: Tensor | None = None, **conditions: Condition
    ) -> Tensor:
        """Return corrected points in the camera frame, shape (..., H, W, 3), metres."""
        return self.geometry.points(self(depth, amplitude, **conditions))

    def points_tool(
        self, depth: Tensor, amplitude: Tensor | None = None, **conditions: Condition
    ) -> Tensor:
        """Return corrected points in the tool frame, shape (..., H, W, 3), metres."""
        points = self.points(depth, amplitude, **conditions)
        return transformed(self.hand_eye().to(points.dtype), points)

    def point_to_plane_loss(self, batch: FrameBatch) -> Tensor:
        """Return the mean squared distance of corrected points to their planes, square metres.

        The loss that `fit` minimises, for training loops of one's own: differentiable in all
        parameters, the hand-eye transform included. `batches` yields the batches of a recording.

        Args:
            batch: Frames with the planes that they show; pixels that are not valid do not count.

        Raises:
            FrameError: The model needs amplitudes and the batch has none.
        """
        return loss.point_to_plane_loss(
            batch,
            self.error_model,
            self.hand_eye,
            self.geometry.ray_directions,
            self.ranges.mean_conditions,
        )

    def _error(
        self, depth: Tensor, amplitude: Tensor | None, conditions: dict[str, Condition]
    ) -> tuple[Tensor, Tensor]:
        """Return the error in the camera's kind of depth, in the module's dtype, and where seen."""
        self.geometry.check(depth, amplitude)
        given = correcting.measured(depth, amplitude, self.error_model, self.geometry, self.ranges)
        known = self._conditions(depth, conditions)
        radial = correcting.radial_error(given, known, self.error_model, self.ranges)
        return radial / self.geometry.radial_of_depth, given.seen

    def _conditions(self, depth: Tensor, given: dict[str, Condition]) -> Tensor | None:
        mean = self.ranges.mean_conditions
        known = in_si_units(given, depth.shape[:-2], mean.dtype, mean.device)
        return with_means(known, mean) if known and len(self.error_model.condition_terms) else None
