"""Uncertainty of the result: intervals of the hand-eye, standard errors of the error's curves."""

import math
from typing import Any

import torch
from torch import Tensor

from tofcorr.error_terms.model import ErrorModel
from tofcorr.errors import CalibrationDataError
from tofcorr.estimation.bootstrap import bootstrap, draw_block_weights
from tofcorr.estimation.statistics import student_quantile
from tofcorr.fit.fitting import Fit

# Coverage of the intervals: the customary 95 %.
_LEVEL = 0.95
# Points of each curve in calibration.yaml. Set by hand.
_CURVE_POINTS = 21
# Resamples of the bootstrap: a standard deviation of 1000 values is known to 2 %.
_RESAMPLES = 1000


def hand_eye_intervals(fit: Fit, level: float = _LEVEL) -> tuple[Tensor, Tensor]:
    """Return the half-widths of the intervals of translation and rotation, each (3,).

    They are about the tool's axes, in metres and radians: standard errors by leaving out one pose
    at a time, with what is left of the noise's shift, times the t distribution's quantile.
    Its degrees of freedom are the poses less one.
    """
    transform = fit.solution.parameters.tool_from_camera
    rotation, covariance = transform[:3, :3], fit.hand_eye_covariance
    quantile = student_quantile((1 + level) / 2, fit.covariance.degrees_of_freedom)
    blocks = covariance[:3, :3], covariance[3:6, 3:6]
    spreads = [(rotation @ block @ rotation.T).diagonal().clamp(min=0).sqrt() for block in blocks]
    return quantile * spreads[0], quantile * spreads[1]


def bootstrap_summary(fit: Fit, generator: torch.Generator) -> dict[str, Any] | None:
    """Return standard errors from a thousand resamples of poses.

    None with too few poses, and where a resample leaves something undetermined.

    Args:
        fit: The fitted model.
        generator: Source of randomness.
    """
    try:
        weights = draw_block_weights(fit.poses, _RESAMPLES, generator)
    except CalibrationDataError:
        return None
    optimum = fit.optimum
    drawn = bootstrap(fit.moments, optimum, weights, fit.total_prior)
    if not bool(drawn.steps.isfinite().all()):
        return None
    summary: dict[str, Any] = {"resamples": _RESAMPLES, "poses": int(fit.poses.max()) + 1}
    if optimum.hand_eye_is_free:
        rotation = optimum.tool_from_camera[:3, :3]
        translation = 1e3 * (drawn.steps[:, :3] @ rotation.T)
        turn = torch.rad2deg(drawn.steps[:, 3:6] @ rotation.T)
        summary["translation_se_mm"] = translation.std(dim=0).tolist()
        summary["rotation_se_deg"] = turn.std(dim=0).tolist()
    return summary


def correction_curves(fit: Fit) -> dict[str, list[dict[str, float]]]:
    """Return the predicted error with its standard error over the calibrated ranges.

    The curves are those of the image's centre. Along `distance` the amplitude is the one typical of
    each distance (the middle of A D^2, within the calibrated range); along `amplitude` the distance
    is the middle one. A curve may be known well although its coefficients are not.
    """
    domain = fit.domain
    middle = torch.full((_CURVE_POINTS,), domain.radial_distance.centre, dtype=torch.float64)
    distance = torch.linspace(*domain.radial_distance, _CURVE_POINTS, dtype=torch.float64)
    if domain.amplitude is None or domain.normalised_amplitude is None:
        return {"distance": _curve(fit, distance, torch.ones_like(distance))}
    typical = domain.normalised_amplitude.centre / distance.square()
    amplitude = torch.linspace(*domain.amplitude, _CURVE_POINTS, dtype=torch.float64)
    return {
        "distance": _curve(fit, distance, typical.clamp(*domain.amplitude)),
        "amplitude": _curve(fit, middle, amplitude),
    }


def _curve(fit: Fit, distance: Tensor, amplitude: Tensor) -> list[dict[str, float]]:
    first = fit.solution.parameters.twist_size
    covariance = fit.covariance.matrix[first:, first:]
    coefficients = fit.solution.parameters.coefficients
    basis = central_basis(fit.model.error, distance, amplitude)
    # Condition terms come last; they are zero at the mean conditions.
    known = basis.shape[1]
    error = basis @ coefficients[:known]
    variance = ((basis @ covariance[:known, :known]) * basis).sum(dim=1)
    quantities = (distance, amplitude, 1e3 * error, 1e3 * variance.clamp(min=0).sqrt())
    names = ("radial_distance_m", "amplitude", "error_mm", "standard_error_mm")
    return [dict(zip(names, row, strict=True)) for row in torch.stack(quantities, dim=1).tolist()]


def central_basis(model: ErrorModel, distance: Tensor, amplitude: Tensor) -> Tensor:
    """Return the functions that the coefficients multiply, in the image's centre, shape (S, K)."""
    row = torch.full_like(distance, (model.height - 1) / 2)
    column = torch.full_like(distance, (model.width - 1) / 2)
    with torch.no_grad():
        signal = [term.basis(distance, amplitude) for term in model.signal_terms]  # type: ignore[operator]
        pixel = [term.basis(row, column) for term in model.pixel_terms]  # type: ignore[operator]
    return torch.cat([torch.ones_like(distance)[None], *signal, *pixel]).T


def interval_summary(fit: Fit) -> dict[str, Any]:
    """Return the 95 % intervals of the hand-eye transform as half-widths in mm and degrees."""
    if not fit.solution.parameters.hand_eye_is_free:
        return {}
    translation, rotation = hand_eye_intervals(fit)
    return {
        "translation_ci95_mm": (1e3 * translation).tolist(),
        "rotation_ci95_deg": (rotation * (180 / math.pi)).tolist(),
    }
