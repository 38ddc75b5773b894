"""The corrector that runs on the robot: from measured frames to corrected frames and validity."""

import json
import math

import torch
from torch import Tensor, nn

from tofcorr.correction.frame_check import check_frames
from tofcorr.correction.limits import Limits
from tofcorr.correction.metadata import corrector_metadata
from tofcorr.correction.runtime_error import RuntimeErrorModel
from tofcorr.correction.runtime_range import RuntimeRange
from tofcorr.correction.runtime_sigma import RuntimeSigma
from tofcorr.correction.state import CalibrationState
from tofcorr.geometry.rays import ray_directions
from tofcorr.geometry.se3 import transformed

# The error is computed times -2^40, so that `torch.lerp` with the weight w = 2^-40 subtracts it:
# depth + w (-e / w - depth). Unlike a plain subtraction this turns an infinite depth into NaN in
# the same pass. It changes the depth by 1e-12 of itself, far below the resolution of float32.
_WEIGHT = 2.0**-40
_FACTOR = -1.0 / _WEIGHT

# Number of pixels that are corrected at once on a CPU. For many pixels the allocator returns the
# temporaries to the system after every call, and getting them back page by page takes longer than
# the arithmetic; for few, the calls dominate. Set on benchmarks/runtime.py.
_STRIP_PIXELS = 400_000


class DepthCorrector(nn.Module):
    """Corrects depth frames in float32: the module that becomes `corrector.ts`.

    `corrected, valid = corrector(depth, amplitude)`. Input and output are depth of the camera's
    kind, radial or z; the error is a function of the radial distance.

    * A pixel without a return (NaN, infinite, zero or negative) gives NaN and is not valid.
    * Outside the calibrated range of distance or amplitude the error at the range's edge is
      subtracted, and the pixel is not valid.
    * A saturated pixel is not valid.
    * An amplitude of NaN gives NaN and is not valid, if the model depends on the amplitude. If it
      does not, amplitudes only matter for saturation.
    * A residual network fades to zero outside the calibrated range.
    * Frames are taken to have the mean conditions (time, integration time, temperature) of the
      calibration, until `set_conditions` is called.

    Use `from_state`. The module has no trainable parameter and writes in place; for autograd there
    is `tofcorr.DepthCorrection`.

    Args:
        state: The calibration.

    Shape:
        - Input: `(H, W)` or `(B, H, W)` twice, float32: metres, and the camera's amplitude units.
        - Output: the same shape, float32 metres; the same shape, bool.
    """

    radial_of_z: Tensor
    points_at_one: Tensor
    tool_from_camera: Tensor
    mean_conditions: list[float]

    def __init__(self, state: CalibrationState) -> None:
        super().__init__()
        error = state.model().error
        limits = Limits.of(state, error)
        rays = ray_directions(state.camera)
        self.height: int = state.camera.height
        self.width: int = state.camera.width
        self.strip_pixels: int = _STRIP_PIXELS
        self.weight: float = _WEIGHT
        self.is_z: bool = state.depth_kind == "z"
        self.radial_range = RuntimeRange(limits.radial_distance, positive=True)
        self.amplitude_range = RuntimeRange(limits.amplitude)
        self.least_normalised, self.most_normalised = limits.normalised_amplitude
        self.saturation: float = limits.saturation_amplitude
        # If the calibrated range ends below saturation, it already excludes saturated pixels.
        known = self.saturation < math.inf
        self.checks_saturation: bool = known and limits.amplitude.high >= self.saturation
        self.error = RuntimeErrorModel(error, limits, _FACTOR)
        self.mean_conditions = state.domain.mean_conditions()
        self.conditions_inside: bool = True
        self.uncertainty = RuntimeSigma(state, error, limits)
        z = rays[..., 2]
        per_depth = rays / z[..., None] if self.is_z else rays
        factors = z if self.is_z else z.new_ones(1, 1)
        self.register_buffer("radial_of_z", (1.0 / factors).float().contiguous())
        self.register_buffer("points_at_one", per_depth.float().contiguous())
        self.register_buffer("tool_from_camera", state.tool_from_camera.detach().float().clone())
        self.metadata_text: str = json.dumps(corrector_metadata(state, limits), allow_nan=False)

    @classmethod
    def from_state(cls, state: CalibrationState) -> "DepthCorrector":
        """Build the corrector of a calibration."""
        return cls(state).eval()

    def forward(self, depth: Tensor, amplitude: Tensor) -> tuple[Tensor, Tensor]:
        """Return corrected depth, metres, and where it is valid.

        Raises:
            ValueError: Shape or dtype are not those of the camera (`torch.jit.Error` once
                scripted).
        """
        check_frames(depth, amplitude, self.height, self.width)
        depth, amplitude = depth.contiguous(), amplitude.contiguous()
        corrected = torch.empty_like(depth)
        valid = torch.empty_like(depth, dtype=torch.bool)
        # Only scripted code asks for the size: an exported graph must hold for any batch.
        scripted = torch.jit.is_scripting()  # pyright: ignore[reportPrivateImportUsage]
        if scripted and depth.numel() > self.strip_pixels and not depth.is_cuda:
            self.correct_in_strips(depth, amplitude, corrected, valid)
        else:
            scale = self.radial_of_z
            offset, rows = self.error.offset, self.error.rows
            self.correct(depth, amplitude, offset, scale, rows, corrected, valid)
        if not self.conditions_inside:
            valid.zero_()
        return corrected, valid

    @torch.jit.export
    def set_conditions(
        self,
        timestamp_s: float | None = None,
        integration_time_us: float | None = None,
        room_temperature_c: float | None = None,
        body_temperature_c: float | None = None,
        ambient: float | None = None,
    ) -> None:
        """Set the conditions of the next frames; what is not given is the calibration's mean.

        Conditions that the model does not depend on change nothing. Outside the calibrated range
        the error at the range's edge is subtracted, and no pixel is valid.

        Args:
            timestamp_s: Seconds since the camera was started as for the calibration.
            integration_time_us: Microseconds.
            room_temperature_c: Degrees Celsius.
            body_temperature_c: Degrees Celsius.
            ambient: Background light, the camera's units.
        """
        values = torch.tensor(self.mean_conditions, dtype=torch.float64)
        if timestamp_s is not None:
            values[0] = timestamp_s
        if integration_time_us is not None:
            values[1] = integration_time_us * 1e-6
        if room_temperature_c is not None:
            values[2] = room_temperature_c
        if body_temperature_c is not None:
            values[3] = body_temperature_c
        if ambient is not None:
            values[4] = ambient
        self.conditions_inside = self.error.set_conditions(values.to(self.radial_of_z.device))

    @torch.jit.export
    def points(self, depth: Tensor, amplitude: Tensor) -> Tensor:
        """Return corrected points in the camera frame, shape (..., H, W, 3), metres."""
        corrected, _ = self.forward(depth, amplitude)
        return corrected.unsqueeze(-1) * self.points_at_one

    @torch.jit.export
    def points_tool(self, depth: Tensor, amplitude: Tensor) -> Tensor:
        """Return corrected points in the tool frame, shape (..., H, W, 3), metres."""
        return transformed(self.tool_from_camera, self.points(depth, amplitude))

    @torch.jit.export
    def sigma(self, depth: Tensor, amplitude: Tensor) -> tuple[Tensor, Tensor]:
        """Return how uncertain the corrected depth is, by noise and by calibration, metres.

        Standard deviations of depth of the camera's kind, the shape of `depth`. Noise is
        independent from frame to frame; the calibration's error is the same in every frame. NaN
        where there is no return, or where the calibration states none.
        """
        check_frames(depth, amplitude, self.height, self.width)
        radial = depth * self.radial_of_z
        noise, calibration = self.uncertainty(
            radial, amplitude, self.error.rows, self.error.columns
        )
        return noise / self.radial_of_z, calibration / self.radial_of_z

    @torch.jit.export
    def metadata(self) -> str:
        """Return camera, model, validity range and versions as JSON text."""
        return self.metadata_text

    def correct_in_strips(
        self, depth: Tensor, amplitude: Tensor, corrected: Tensor, valid: Tensor
    ) -> None:
        """Correct some rows of all frames at a time."""
        strips = (depth.numel() + self.strip_pixels - 1) // self.strip_pixels
        rows = max(1, (self.height + strips - 1) // strips)
        depths, amplitudes = depth.split(rows, -2), amplitude.split(rows, -2)
        offsets, row_numbers = self.error.offset.split(rows), self.error.rows.split(rows)
        scales = self.radial_of_z.split(rows)
        outputs, masks = corrected.split(rows, -2), valid.split(rows, -2)
        for k in range(len(depths)):
            self.correct(
                depths[k],
                amplitudes[k],
                offsets[k],
                scales[k] if self.is_z else self.radial_of_z,
                row_numbers[k],
                outputs[k],
                masks[k],
            )

    def correct(
        self,
        depth: Tensor,
        amplitude: Tensor,
        offset: Tensor,
        radial_of_z: Tensor,
        rows: Tensor,
        corrected: Tensor,
        valid: Tensor,
    ) -> None:
        """Correct rows into `corrected` and `valid` (bool, or any type that holds 0 and 1).

        Speed depends on the number of arrays that each operation reads and writes. So `corrected`
        also holds intermediate results, and masks are float 0 and 1: comparisons that give bool
        are not vectorised.
        """
        radial = depth * radial_of_z if self.is_z else depth
        # A missing return becomes NaN here, and stays NaN in all that follows.
        distance = self.radial_range.held(radial)
        error = self.error.distance(offset, distance, corrected)
        strength = amplitude
        if self.error.needs_amplitude:
            strength = self.amplitude_range.held(amplitude)
        if self.error.has_amplitude:
            self.error.amplitude.add_to(error, strength)
        if self.error.has_others:
            self.error.add_others(error, distance, strength)
        if self.error.has_network:
            self.error.add_network(error, radial, amplitude, rows)
        if self.error.has_normalised:
            normalised = (strength * distance).mul_(distance)
            held = torch.clamp(normalised, self.least_normalised, self.most_normalised)
            self.error.normalised.add_to(error, held)
            inside = self.radial_range.inside(radial, distance).mul_(normalised.eq_(held))
        else:
            inside = self.radial_range.inside(radial, distance)
        if self.error.needs_amplitude:
            inside.mul_(self.amplitude_range.inside(amplitude, strength))
        if self.checks_saturation:
            inside.gt_(amplitude.clone().ge_(self.saturation))
        valid.copy_(inside)
        if self.is_z:
            error.div_(radial_of_z)
        torch.lerp(depth, error, self.weight, out=corrected)
