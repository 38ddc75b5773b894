"""The correction of frames: differentiable, without writing into any tensor."""

from typing import NamedTuple

import torch
from torch import Tensor

from tofcorr.error_terms.model import ErrorModel
from tofcorr.errors import FrameError
from tofcorr.module.geometry import CameraGeometry
from tofcorr.module.ranges import CalibratedRanges


class Measured(NamedTuple):
    """Frames in the variables of the error model, shapes (..., H, W).

    Where there is no measurement the variables are those of the middle of the calibrated ranges,
    so that neither the error nor its gradient is NaN there.

    Attributes:
        seen: Where distance, and amplitude if the model needs it, were measured, bool.
        radial: Radial distance as measured, metres.
        strength: Amplitude as measured; equal to `radial` if the model does not need it.
        distance: `radial`, clamped to its calibrated range.
        held_strength: `strength`, clamped likewise.
    """

    seen: Tensor
    radial: Tensor
    strength: Tensor
    distance: Tensor
    held_strength: Tensor


def measured(
    depth: Tensor,
    amplitude: Tensor | None,
    error: ErrorModel,
    geometry: CameraGeometry,
    ranges: CalibratedRanges,
) -> Measured:
    """Turn frames into the variables of the error model, in the dtype of its parameters.

    Raises:
        FrameError: The model needs amplitudes and there are none.
    """
    dtype = error.constant.dtype
    depth = depth.to(dtype)
    seen = torch.isfinite(depth) & (depth > 0)
    strength = None
    if error.needs_amplitude():
        strength = required_amplitude(amplitude).to(dtype)
        seen = seen & ~torch.isnan(strength)
    radial = torch.where(seen, depth * geometry.radial_of_depth, ranges.radial_distance.mean())
    distance = radial.clamp(ranges.radial_distance[0], ranges.radial_distance[1])
    if strength is None:
        return Measured(seen, radial, radial, distance, radial)
    strength = torch.where(seen, strength, ranges.amplitude.mean())
    held = strength.clamp(ranges.amplitude[0], ranges.amplitude[1])
    return Measured(seen, radial, strength, distance, held)


def required_amplitude(amplitude: Tensor | None) -> Tensor:
    """Return the amplitudes that a model needs.

    Raises:
        FrameError: There are none.
    """
    if amplitude is None:
        raise FrameError(
            "amplitude: the model has a term of the amplitude and got no amplitudes; pass them, or "
            "choose terms without amplitude."
        )
    return amplitude


def radial_error(
    given: Measured, conditions: Tensor | None, error: ErrorModel, ranges: CalibratedRanges
) -> Tensor:
    """Return the predicted error along the ray, shape (..., H, W), metres.

    Args:
        given: The frames.
        conditions: Their conditions, shape (..., C); None: the mean conditions.
        error: The error model.
        ranges: Its calibrated ranges.
    """
    total = error.pixel_error()
    for term in error.signal_terms:
        strength = given.held_strength
        if term.uses_normalised_amplitude:
            square = given.distance.square()
            low, high = ranges.normalised_amplitude[0], ranges.normalised_amplitude[1]
            strength = (strength * square).clamp(low, high) / square
        total = total + term(given.distance, strength)
    if conditions is not None:
        total = total + error.condition_error(conditions)[..., None, None]
    if error.residual is not None:
        rows, columns = error.pixel_grid()
        total = total + error.residual(given.radial, given.strength, rows, columns)
    return total


def valid_pixels(
    given: Measured,
    amplitude: Tensor | None,
    conditions: Tensor | None,
    error: ErrorModel,
    ranges: CalibratedRanges,
) -> Tensor:
    """Return where all variables are within their calibrated ranges, shape (..., H, W), bool.

    Args:
        given: The frames.
        amplitude: As measured, for saturation; None if unknown.
        conditions: Their conditions, shape (..., C); None: the mean conditions.
        error: The error model.
        ranges: Its calibrated ranges.
    """
    valid = given.seen & (given.distance == given.radial)
    if error.needs_amplitude():
        valid = valid & (given.held_strength == given.strength)
    if error.needs_normalised_amplitude():
        normalised = given.held_strength * given.distance.square()
        low, high = ranges.normalised_amplitude[0], ranges.normalised_amplitude[1]
        valid = valid & (normalised == normalised.clamp(low, high))
    if amplitude is not None:
        valid = valid & ~(amplitude >= ranges.saturation_amplitude)
    if conditions is not None:
        for term in error.condition_terms:
            valid = valid & term.covers(conditions)[..., None, None]  # type: ignore[operator]
    return valid
