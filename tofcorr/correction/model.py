"""The correction: what a calibration fits, and how it corrects frames, differentiable throughout.

In float64 it is the reference: the runtime is folded from it, every export must agree with it.
"""

import copy
from collections.abc import Sequence

import numpy as np
import torch
import torch.distributed as dist
from torch import Tensor, nn

from tofcorr.conditions import CONDITIONS
from tofcorr.error_terms.base import DescribedModule, Domain
from tofcorr.error_terms.condition_terms import Condition, in_si_units, with_means
from tofcorr.error_terms.model import ErrorModel
from tofcorr.errors import FrameError
from tofcorr.geometry import se3
from tofcorr.geometry.camera import DISTORTION_LENGTHS, CameraIntrinsics, DepthKind
from tofcorr.geometry.rays import ray_directions
from tofcorr.geometry.se3 import product, projected, transformed

Transform = Tensor | np.ndarray | Sequence[Sequence[float]]
"""Four rows of four."""
Amplitude = Tensor | None
"""The camera's units, the shape of the depth; None where no term of the model needs it."""


class HandEye(nn.Module):
    r"""A rigid transform near an initial guess, optimised without constraints.

    .. math:: T_\mathrm{tool \leftarrow camera} = T_0 \exp(\hat\xi)

    The twist :math:`\xi` starts at zero, so training starts at the guess, and any value an
    optimiser writes into it is a valid rotation and translation.

    Args:
        start: The guess T_0, shape (4, 4), metres; the identity when not given.
        fixed: Whether the transform is known and stays as it is.

    Raises:
        ValueError: `start` is not a rigid transform.

    Attributes:
        start: T_0, a buffer of shape (4, 4), float64.
        twist: The parameter, shape (6,), translational part first, metres and radians, float64.
    """

    start: Tensor

    def __init__(self, start: Transform | None = None, *, fixed: bool = False) -> None:
        super().__init__()
        self.register_buffer("start", _rigid(torch.eye(4) if start is None else start))
        self.twist = nn.Parameter(torch.zeros(6, dtype=torch.float64), requires_grad=not fixed)

    def forward(self) -> Tensor:
        """Return tool_from_camera, shape (4, 4)."""
        return product(self.start, se3.exp(self.twist))

    @torch.no_grad()
    def rebase(self, transform: Transform) -> None:
        """Set the transform (4, 4): it becomes `start`, and the twist becomes zero."""
        self.start.copy_(_rigid(transform))
        self.twist.zero_()


class CalibrationModel(nn.Module):
    r"""The error model and the hand-eye transform, and the residual to a known plane.

    .. math:: \rho_v = n^\top \left(R\, a_v (D_v - E_v) + t\right) + e

    with :math:`a_v` the unit ray of the pixel, :math:`(R, t)` = tool_from_camera and the plane
    :math:`n^\top x + e = 0` in tool coordinates (Abdo and Borgeat 2010).

    Args:
        error: Predicted error of every pixel, metres along the ray.
        hand_eye: tool_from_camera.
    """

    def __init__(self, error: ErrorModel, hand_eye: HandEye) -> None:
        super().__init__()
        self.error = error
        self.hand_eye = hand_eye

    def residual(
        self,
        radial_distance: Tensor,
        amplitude: Tensor | None,
        ray_directions: Tensor,
        normal_tool: Tensor,
        offset_tool: Tensor,
        conditions: Tensor | None = None,
    ) -> Tensor:
        """Return the signed distance of every corrected point to its plane.

        This is the reference: autograd over pixels. It is differentiable in the error
        coefficients and the twist of the hand-eye.

        Args:
            radial_distance: Measured distances, shape (B, H, W), metres.
            amplitude: Amplitudes, shape (B, H, W); None if the model does not depend on them.
            ray_directions: Unit rays in the camera frame, shape (H, W, 3).
            normal_tool: Unit normals in the tool frame, shape (B, 3).
            offset_tool: Offsets of the planes in the tool frame, shape (B,), metres.
            conditions: The frames' conditions, shape (B, C); None: the mean conditions.

        Returns:
            Distances to the plane, shape (B, H, W), metres; positive on the normal's side.

        Raises:
            FrameError: The model depends on the amplitude and got none.
        """
        needed = self.error.needs_amplitude()
        strength = required_amplitude(amplitude) if needed else radial_distance
        corrected = radial_distance - self.error(radial_distance, strength, conditions)
        tool_from_camera = self.hand_eye()
        cosine = projected(ray_directions, product(normal_tool, tool_from_camera[:3, :3]))
        origin_to_plane = (normal_tool * tool_from_camera[:3, 3]).sum(-1) + offset_tool
        return cosine * corrected + origin_to_plane[:, None, None]


def _rigid(transform: Transform) -> Tensor:
    """Return a float64 copy of `transform`, after checking that it is rigid."""
    matrix = torch.as_tensor(transform, dtype=torch.float64).detach().clone()
    try:
        # More is a mistake rather than rounding.
        se3.refuse_unless_rigid(matrix.cpu().numpy(), 10 * torch.finfo(torch.float32).eps)
    except ValueError as error:
        raise ValueError(f"A hand-eye transform: {error}, got {matrix.tolist()}.") from None
    return matrix


AGREEMENT = 1e-6
"""How far runtime and exports may be from this correction in float64, metres: float32 resolves
1e-7 m at one metre."""


class CameraGeometry(nn.Module):
    """Image size, pinhole matrix, distortion and rays of a camera, and what its depth means.

    Args:
        camera: The lateral parameters.
        depth_kind: `radial`: depth is along the ray; `z`: along the optical axis.

    Attributes:
        matrix: The pinhole matrix K, shape (3, 3), pixels.
        distortion: OpenCV's coefficients, filled with zeros, shape (14,).
        ray_directions: Unit rays in the camera frame, shape (H, W, 3).
        radial_of_depth: Radial distance over depth, shape (H, W): 1 for radial depth.
    """

    advice = "Was the frame cropped, binned or transposed?"
    matrix: Tensor
    distortion: Tensor
    ray_directions: Tensor
    radial_of_depth: Tensor

    def __init__(self, camera: CameraIntrinsics, depth_kind: DepthKind) -> None:
        super().__init__()
        # As long as OpenCV's longest list, so that the buffer has one shape for every camera.
        distortion = torch.zeros(max(DISTORTION_LENGTHS), dtype=torch.float64)
        distortion[: len(camera.distortion)] = torch.tensor(camera.distortion)
        size = (camera.height, camera.width)
        self.register_buffer("matrix", camera.matrix_tensor())
        self.register_buffer("distortion", distortion)
        self.register_buffer("ray_directions", ray_directions(camera).clone())
        self.register_buffer("radial_of_depth", torch.ones(size, dtype=torch.float64))
        self.set_depth_kind(depth_kind)

    def cropped(self, top: int, left: int, camera: CameraIntrinsics) -> "CameraGeometry":
        """Return the geometry of a part of the image; the rays are those of this one."""
        part = copy.copy(self)
        part._buffers = dict(self._buffers)
        for name in ("ray_directions", "radial_of_depth"):
            image = getattr(self, name)
            part._buffers[name] = image[top : top + camera.height, left : left + camera.width]
        part._buffers["matrix"] = camera.matrix_tensor().to(self.matrix)
        return part

    @torch.no_grad()
    def set_depth_kind(self, depth_kind: DepthKind) -> None:
        """State what depth means."""
        self.radial_of_depth.fill_(1.0)
        if depth_kind == "z":
            self.radial_of_depth.div_(self.ray_directions[..., 2])

    def points(self, depth: Tensor) -> Tensor:
        """Return the points of depths (..., H, W) in the camera frame, (..., H, W, 3), metres."""
        rays = self.ray_directions * self.radial_of_depth[..., None]
        return depth[..., None] * rays.to(depth.dtype)

    def check(self, **frames: Tensor | None) -> None:
        """Refuse tensors that are not frames of the camera, by the names that their caller knows.

        Args:
            **frames: The depth, then images of its shape; None: there is none.

        Raises:
            FrameError: It is no tensor, or shape or dtype are not those of the camera's frames.
        """
        height, width = self.radial_of_depth.shape
        given = {name: frame for name, frame in frames.items() if frame is not None}
        (first, depth), *_ = given.items()
        for name, frame in given.items():
            if not isinstance(frame, Tensor):
                got = type(frame).__name__
                raise FrameError(f"{name}: expected a torch tensor, got {got}.")
            if not frame.dtype.is_floating_point:
                raise FrameError(f"{name}: expected floating-point metres, got {frame.dtype}.")
            if frame.shape != depth.shape:
                shapes = f"expected {first}'s shape {[*depth.shape]}, got {[*frame.shape]}"
                raise FrameError(f"{name}: {shapes}.")
        if depth.dim() < 2 or list(depth.shape[-2:]) != [height, width]:
            got = f"got {[*depth.shape]}. {self.advice}"
            raise FrameError(f"{first}: expected shape (..., {height}, {width}); {got}")


class CalibratedRanges(nn.Module):
    """Where a correction is valid, and the mean conditions it was calibrated in.

    Attributes:
        radial_distance: Lowest and highest distance along the ray, shape (2,), metres.
        amplitude: Of the amplitude, shape (2,); infinite if the model does not depend on it.
        normalised_amplitude: Of N = I D^2, shape (2,); infinite likewise.
        saturation_amplitude: A pixel at or above it is not valid, shape (); infinite if unknown.
        mean_conditions: In the order of `CONDITIONS`, shape (C,); 0 where unknown.
    """

    radial_distance: Tensor
    amplitude: Tensor
    normalised_amplitude: Tensor
    saturation_amplitude: Tensor
    mean_conditions: Tensor

    def __init__(self) -> None:
        super().__init__()
        for name in ("radial_distance", "amplitude", "normalised_amplitude"):
            self.register_buffer(name, torch.zeros(2, dtype=torch.float64))
        self.register_buffer("saturation_amplitude", torch.zeros((), dtype=torch.float64))
        means = torch.zeros(len(CONDITIONS), dtype=torch.float64)
        self.register_buffer("mean_conditions", means)

    @torch.no_grad()
    def set(self, domain: Domain, saturation: float | None, error: ErrorModel) -> None:
        """Take the ranges of a calibration.

        Args:
            domain: The calibrated ranges.
            saturation: Amplitude from which on pixels are saturated; None if unknown.
            error: The model, whose terms say which variables it depends on.
        """
        limits = error.limits(domain)
        for name in ("radial_distance", "amplitude", "normalised_amplitude"):
            getattr(self, name).copy_(torch.tensor(getattr(limits, name), dtype=torch.float64))
        most = torch.tensor(torch.inf if saturation is None else saturation)
        self.saturation_amplitude.copy_(most.float())  # Rounded as the runtime's.
        means = torch.tensor(domain.mean_conditions(), dtype=torch.float64)
        self.mean_conditions.copy_(means)


class FrameCorrection(DescribedModule):
    r"""Corrects frames, differentiable in depth, amplitude and every parameter.

    .. math:: D_\mathrm{corrected} = D - E(D, I, r, c, \text{conditions})

    A pixel without a return (NaN, infinite, or not positive) gives NaN, and so does an amplitude of
    NaN that the model needs. Each variable of the error is clamped to its calibrated range; where
    that changes it, or the amplitude is saturated, the pixel is not valid. The inputs of a residual
    network are not clamped: it fades to zero outside.

    Args:
        camera: The lateral parameters.
        depth_kind: What depth means.
        error_model: The terms and the residual network, which predict the error E.
        hand_eye: tool_from_camera, as a twist around a starting transform.
        domain: The calibrated ranges.
        saturation_amplitude: A pixel at or above it is not valid; None if unknown.

    Attributes:
        geometry: The camera, as buffers.
        ranges: The calibrated ranges, as buffers.
    """

    error_model: ErrorModel
    hand_eye: HandEye

    def __init__(
        self,
        camera: CameraIntrinsics,
        depth_kind: DepthKind,
        error_model: ErrorModel,
        hand_eye: HandEye,
        domain: Domain,
        saturation_amplitude: float | None,
    ) -> None:
        super().__init__()
        self.error_model = error_model
        self.hand_eye = hand_eye
        self.geometry = CameraGeometry(camera, depth_kind)
        self.ranges = CalibratedRanges()
        self.ranges.set(domain, saturation_amplitude, error_model)

    def forward(
        self,
        depth: Tensor,
        amplitude: Amplitude = None,
        *,
        fill: float = torch.nan,
        **conditions: Condition,
    ) -> Tensor:
        """Return corrected depth.

        Args:
            depth: Of the camera's `depth_kind`, shape (..., H, W), metres.
            amplitude: The camera's units, the shape of `depth`; None where no term needs it.
            **conditions: `timestamp_s`, `integration_time_us`, `room_temperature_c`,
                `body_temperature_c`, `ambient`: one number, or one for each frame (...). What is
                not given is taken as the mean of the calibration.
            fill: What to give where there is no return, such as 0 before a network.

        Returns:
            A new tensor of the shape and dtype of `depth`, metres; `fill` where there is no return.

        Raises:
            FrameError: The frames are of another size or dtype, or amplitudes are missing.
        """
        error, seen = self._error(depth, amplitude, conditions)
        corrected = depth.to(error.dtype) - error
        if dist.is_available() and dist.is_initialized():
            # DistributedDataParallel waits for a gradient of every parameter that it may train, of
            # the hand-eye transform and of conditions that were not given, too: it is zero.
            trained = [one.sum() for one in self.parameters() if one.requires_grad]
            corrected = corrected + 0.0 * sum(trained)
        return torch.where(seen, corrected, fill).to(depth.dtype)

    def error(self, depth: Tensor, amplitude: Amplitude = None, **conditions: Condition) -> Tensor:
        """Return the predicted error, measured - true: depth - error is the corrected depth.

        Arguments, shape and dtype are those of `forward`.
        """
        error, seen = self._error(depth, amplitude, conditions)
        return torch.where(seen, error, torch.nan).to(depth.dtype)

    def valid(self, depth: Tensor, amplitude: Amplitude = None, **conditions: Condition) -> Tensor:
        """Return where the correction is valid, bool, the shape of `depth`.

        Not valid is a pixel without a return, a saturated one, and one whose distance, amplitude
        or conditions are outside the calibrated range. The rule is that of `corrector.ts`.
        """
        model, ranges = self.error_model, self.ranges
        seen, radial, strength, distance, held = self._variables(depth, amplitude)
        valid = seen & (distance == radial)
        if model.needs_amplitude():
            valid = valid & (held == strength)
        if model.needs_normalised_amplitude():
            normalised = held * distance.square()
            low, high = ranges.normalised_amplitude.unbind()
            valid = valid & (normalised == normalised.clamp(low, high))
        if amplitude is not None:
            saturated = amplitude >= ranges.saturation_amplitude
            valid = valid & ~(saturated & ranges.saturation_amplitude.isfinite())
        known = self._conditions(depth, conditions)
        for term in () if known is None else model.condition_terms:
            valid = valid & term.covers(known)[..., None, None]  # type: ignore[operator]
        return valid

    def points(self, depth: Tensor, amplitude: Amplitude = None, **conditions: Condition) -> Tensor:
        """Return corrected points in the camera frame, shape (..., H, W, 3), metres."""
        return self.geometry.points(self(depth, amplitude, **conditions))

    def points_tool(
        self, depth: Tensor, amplitude: Amplitude = None, **conditions: Condition
    ) -> Tensor:
        """Return corrected points in the tool frame, shape (..., H, W, 3), metres."""
        points = self.points(depth, amplitude, **conditions)
        return transformed(self.hand_eye().to(points.dtype), points)

    def _error(
        self, depth: Tensor, amplitude: Amplitude, conditions: dict[str, Condition]
    ) -> tuple[Tensor, Tensor]:
        """Return the error in the camera's kind of depth, in the module's dtype, and where seen."""
        model = self.error_model
        seen, radial, strength, distance, held = self._variables(depth, amplitude)
        bounds = self.ranges.normalised_amplitude.unbind()
        error = model.pixel_error() + model.signal_error(distance, held, bounds)
        known = self._conditions(depth, conditions)
        if known is not None:
            error = error + model.condition_error(known)[..., None, None]
        if model.residual is not None:
            error = error + model.residual(radial, strength, *model.pixel_grid())
        return error / self.geometry.radial_of_depth, seen

    def _variables(
        self, depth: Tensor, amplitude: Amplitude
    ) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
        """Turn frames into the variables of the error model, in the dtype of its parameters.

        Where there is no measurement the variables are those of the middle of the calibrated
        ranges, so that neither the error nor its gradient is NaN there.

        Returns:
            Where distance, and amplitude if the model needs it, were measured, bool; radial
            distance and amplitude as measured; both clamped to their calibrated ranges. Without
            need for amplitudes these are the radial distances.
        """
        self.geometry.check(depth=depth, amplitude=amplitude)
        ranges, dtype = self.ranges, self.error_model.constant.dtype
        depth = depth.to(dtype)
        seen = torch.isfinite(depth) & (depth > 0)
        strength = None
        if self.error_model.needs_amplitude():
            strength = required_amplitude(amplitude).to(dtype)
            seen = seen & ~torch.isnan(strength)
        radial = depth * self.geometry.radial_of_depth
        radial = torch.where(seen, radial, ranges.radial_distance.mean())
        distance = radial.clamp(*ranges.radial_distance.unbind())
        if strength is None:
            return seen, radial, radial, distance, radial
        strength = torch.where(seen, strength, ranges.amplitude.mean())
        return seen, radial, strength, distance, strength.clamp(*ranges.amplitude.unbind())

    def _conditions(self, depth: Tensor, given: dict[str, Condition]) -> Tensor | None:
        mean = self.ranges.mean_conditions
        known = in_si_units(given, depth.shape[:-2], mean.dtype, mean.device)
        return with_means(known, mean) if known and len(self.error_model.condition_terms) else None


def required_amplitude(amplitude: Tensor | None) -> Tensor:
    """Return the amplitudes that a model needs.

    Raises:
        FrameError: There are none.
    """
    if amplitude is None:
        raise FrameError("amplitude: the model has a term of the amplitude; pass or drop it.")
    return amplitude
