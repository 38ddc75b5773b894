"""The correction in float64, written to be read: every export must agree with it."""

import torch
from torch import Tensor

from tofcorr.correction.limits import Limits
from tofcorr.correction.state import CalibrationState
from tofcorr.error_terms.model import ErrorModel
from tofcorr.geometry.ranges import radial_distance_from_z_depth, z_depth_from_radial_distance
from tofcorr.geometry.rays import ray_directions


@torch.no_grad()
def corrected_by_model(
    state: CalibrationState, depth: Tensor, amplitude: Tensor
) -> tuple[Tensor, Tensor]:
    """Correct frames with the float64 model.

    A pixel without a return (NaN, infinite, or not positive) gives NaN, and so does an amplitude
    of NaN that the model needs. Each variable of the error is clamped to its calibrated range;
    where that changes it, or the amplitude is saturated, the pixel is not valid. The inputs of a
    residual network are not clamped: it fades to zero outside.

    Args:
        state: The calibration.
        depth: Depth of the camera's kind, shape (..., H, W), metres.
        amplitude: Amplitudes of the same shape, the camera's units.

    Returns:
        Corrected depth of the same kind, float64, metres, and where it is valid, bool.
    """
    error_model = state.model().error
    limits = Limits.of(state, error_model)
    rays = ray_directions(state.camera)
    depth, amplitude = depth.double(), amplitude.double()
    depth = torch.where((depth > 0) & depth.isfinite(), depth, torch.nan)
    is_z = state.depth_kind == "z"
    measured = radial_distance_from_z_depth(depth, rays) if is_z else depth

    distance = measured.clamp(*limits.radial_distance)
    strength = amplitude.clamp(*limits.amplitude)
    normalised = strength * distance.square()
    valid = distance == measured
    if error_model.needs_amplitude():
        valid &= strength == amplitude
    if error_model.needs_normalised_amplitude():
        valid &= normalised == normalised.clamp(*limits.normalised_amplitude)
    if state.saturation_amplitude is not None:
        valid &= ~(amplitude >= limits.saturation_amplitude)

    error = error_model.pixel_error() + signal_error(error_model, limits, distance, strength)
    rows, columns = error_model.pixel_grid()
    if error_model.residual is not None:
        error += error_model.residual(measured, amplitude, rows, columns)
    corrected = measured - error
    return (z_depth_from_radial_distance(corrected, rays) if is_z else corrected), valid


@torch.no_grad()
def signal_error(
    error_model: ErrorModel, limits: Limits, radial_distance: Tensor, amplitude: Tensor
) -> Tensor:
    """Return the sum of the signal terms, shape (...), float64, metres.

    Args:
        error_model: The model.
        limits: Its limits; the distance-normalised amplitude is clamped to them here.
        radial_distance: Distances inside their limits, shape (...), metres.
        amplitude: Amplitudes inside their limits, same shape.
    """
    normalised = amplitude * radial_distance.square()
    held = normalised.clamp(*limits.normalised_amplitude) / radial_distance.square()
    error = torch.zeros_like(radial_distance)
    for term in error_model.signal_terms:
        error += term(radial_distance, held if term.uses_normalised_amplitude else amplitude)
    return error
