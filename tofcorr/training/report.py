"""The numbers that a training stands for: report.json and calibration.yaml."""

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from torch import Tensor

from tofcorr.estimation.information import PRIOR_SIGMA
from tofcorr.estimation.observability import Direction
from tofcorr.estimation.robust import outlying_images
from tofcorr.fit.fitting import Fit
from tofcorr.pixels.dataset import Dataset
from tofcorr.pixels.metrics import FrameErrors
from tofcorr.training.options import TrainingOptions
from tofcorr.training.support import Support, shortcomings
from tofcorr.training.uncertainty import correction_curves

STAGES = ("before", "hand_eye_only", "after")

# Below this many training images the standard errors themselves are uncertain by a quarter.
_FEW_IMAGES = 10

# From here on a direction is reported as weak: metres or radians.
_WEAK = 5e-3
# How many of the weakest directions the report lists.
_WEAKEST = 5


def error_summary(
    errors: Mapping[str, FrameErrors], train: np.ndarray, test: np.ndarray
) -> dict[str, Any]:
    """Return mean absolute and RMS error of each stage on both halves; null on an empty half."""
    return {
        stage: {
            half: {
                "mean_abs": _or_none(errors[stage].mean_abs_mm(frames)),
                "rms": _or_none(errors[stage].rms_mm(frames)),
            }
            for half, frames in (("train", train), ("test", test))
        }
        for stage in STAGES
    }


def hand_eye_summary(fit: Fit) -> dict[str, Any]:
    """Return the hand-eye transform with standard errors along the tool's axes."""
    parameters = fit.solution.parameters
    summary: dict[str, Any] = {
        "tool_from_camera": parameters.tool_from_camera.tolist(),
        "estimated": parameters.hand_eye_is_free,
        "translation_se_mm": [0.0, 0.0, 0.0],
        "rotation_se_deg": [0.0, 0.0, 0.0],
    }
    if parameters.hand_eye_is_free:
        rotation = parameters.tool_from_camera[:3, :3]
        covariance = fit.covariance.matrix
        translation = _spread(rotation @ covariance[:3, :3] @ rotation.T)
        turn = _spread(rotation @ covariance[3:6, 3:6] @ rotation.T)
        summary["translation_se_mm"] = (1e3 * translation).tolist()
        summary["rotation_se_deg"] = (turn * (180.0 / math.pi)).tolist()
    return summary


def coefficient_summary(fit: Fit) -> dict[str, Any]:
    """Return the coefficients in the paper's symbols, each with its standard error.

    Units are metres, pixels and the camera's amplitude units. The standard errors leave out one
    image at a time, through the conversion to the paper's form.
    """
    error, best = fit.model.error, fit.solution.parameters
    values = error.paper_coefficients()
    shifted: list[dict[str, dict[str, float]]] = []
    for shift in fit.covariance.jackknife:
        error.set_coefficient_vector(best.moved(shift).coefficients)
        shifted.append(error.paper_coefficients())
    error.set_coefficient_vector(best.coefficients)
    return {
        group: {
            symbol: {
                "value": _or_none(value),
                "standard_error": _jackknife_spread([one[group].get(symbol) for one in shifted]),
            }
            for symbol, value in named.items()
        }
        for group, named in values.items()
    }


def warnings(fit: Fit, dataset: Dataset, errors: Mapping[str, Any], support: Support) -> list[str]:
    """Return what a user must know before trusting the result, one sentence each."""
    found: list[str] = []
    if not fit.solution.converged:
        found.append(fit.solution.message)
    if fit.moments.num_images < _FEW_IMAGES:
        found.append(
            f"Only {fit.moments.num_images} images were fitted; standard errors are rough below "
            f"{_FEW_IMAGES}."
        )
    found += [
        f"The images leave {direction.in_words()} free: a prior of {1e3 * PRIOR_SIGMA:g} mm and "
        f"{1e3 * PRIOR_SIGMA:g} mrad around the starting guess stands in for them."
        for direction in fit.observability.undetermined
        if not _is_of_curves(direction, fit)
    ]
    found += [
        f"{direction.in_words()}: only known to {1e3 * direction.sigma:.1f} mm (or mrad)."
        for direction in _weak(fit)
        if not _is_of_curves(direction, fit)
    ]
    found += _loose_curves(fit)
    if fit.residual is not None:
        found.append(fit.residual.in_words())
    found += shortcomings(
        support, moves=fit.solution.parameters.hand_eye_is_free, with_intensity=_has_intensity(fit)
    )
    found += _overfitting(errors)
    if not dataset.moves:
        found.append("No robot pose changes: the hand-eye transform is held at the identity.")
    return found


def observability_summary(fit: Fit, support: Support) -> dict[str, Any]:
    """Return what the images leave open: the weakest directions, and what they cover."""
    return {
        "weakest": [
            {
                "direction": direction.in_words(),
                "sigma_mm_or_mrad": 1e3 * direction.sigma,
                "free": direction.is_undetermined,
                "components": direction.shares,
            }
            for direction in fit.observability.directions[:_WEAKEST]
        ],
        "confounded": [pair._asdict() for pair in fit.observability.confounded],
        "condition": min(fit.observability.condition, 1e300),
        "prior": [] if fit.prior is None else fit.prior.names,
        "support": support.to_mapping(),
    }


def weight_summary(fit: Fit) -> dict[str, Any] | None:
    """Return how pixels were weighted; None if all counted alike."""
    if fit.weights is None:
        return None
    noise = fit.weights.noise
    return {
        "noise": None if noise is None else noise.to_mapping(),
        "robust": fit.weights.loss,
        "scale_mm": None if fit.weights.model is None else 1e3 * fit.weights.scale,
    }


def outlier_summary(errors: FrameErrors) -> list[dict[str, Any]]:
    """Return the images that fit much worse than the others, the worst first."""
    rms = np.sqrt(errors.squared / np.maximum(errors.count, 1))
    return [outlier._asdict() for outlier in outlying_images(errors.frames, rms)]


def _weak(fit: Fit) -> list[Direction]:
    """Return the directions that are determined, but too badly to be of use."""
    return [
        direction
        for direction in fit.observability.directions
        if direction.sigma > _WEAK and not direction.is_undetermined
    ]


def _is_of_curves(direction: Direction, fit: Fit) -> bool:
    """Whether a direction is about coefficients of penalised curves, and their constant, alone."""
    terms = [term for term, _ in fit.model.error.penalised()]
    return set(direction.shares) <= {"c0", *(symbol for term in terms for symbol in term.symbols)}


def _loose_curves(fit: Fit) -> list[str]:
    """Say how badly the worst part of the curves is known: where no pixel was."""
    sigmas = [
        direction.sigma
        for direction in fit.observability.directions
        if direction.sigma > _WEAK and len(direction.shares) > 1 and _is_of_curves(direction, fit)
    ]
    if not sigmas:
        return []
    return [
        f"{len(sigmas)} directions of the curves are held by their smoothness more than by pixels, "
        f"the loosest to {1e3 * max(sigmas):.0f} mm: combinations of distance and amplitude that "
        "the recording does not hold."
    ]


def _has_intensity(fit: Fit) -> bool:
    return fit.model.error.needs_amplitude()


def _overfitting(errors: Mapping[str, Any]) -> list[str]:
    after = errors["after"]
    train, test, bare = after["train"]["rms"], after["test"]["rms"], errors["hand_eye_only"]["test"]
    if test is None:
        return ["No frame was held out: the errors given are those of the fit itself."]
    if test > 1.5 * train:
        return [
            f"The held-out error ({test:.1f} mm RMS) is much larger than that of the fit "
            f"({train:.1f} mm): record more views, or choose a smaller model."
        ]
    if bare["rms"] is not None and test > bare["rms"]:
        return [
            f"The depth correction makes held-out frames worse ({test:.1f} mm RMS) than the "
            f"hand-eye alone ({bare['rms']:.1f} mm): do not use it."
        ]
    return []


def _spread(covariance: Tensor) -> Tensor:
    return covariance.diagonal().clamp(min=0).sqrt()


def _jackknife_spread(values: list[float | None]) -> float | None:
    given = [math.nan if value is None else value for value in values]
    known = torch.tensor(given, dtype=torch.float64)
    count = len(known)
    variance = (count - 1) / count * (known - known.mean()).square().sum()
    return _or_none(float(variance.sqrt()))


def _or_none(value: float) -> float | None:
    """JSON has no NaN: what is not known is null."""
    return value if math.isfinite(value) else None


def calibration_mapping(
    dataset: Dataset, options: TrainingOptions, result: Fit, report: dict[str, Any]
) -> dict[str, Any]:
    """Return the calibration for people and other programs."""
    camera, domain = dataset.first.camera, result.domain
    return {
        "format": "tofcorr-calibration",
        "version": 1,
        "model": options.name,
        "terms": result.options.to_mapping()["terms"],
        "sign": "error = measured - true; corrected = measured - error",
        "units": "metres, pixels, and the camera's own amplitude units",
        "coefficients": coefficient_summary(result),
        "correction_curves": correction_curves(result),
        "hand_eye": report["hand_eye"],
        "validity": {
            "radial_distance_m": list(domain.radial_distance),
            "amplitude": None if domain.amplitude is None else list(domain.amplitude),
        },
        "camera": {
            "width": camera.width,
            "height": camera.height,
            "K": [list(row) for row in camera.matrix],
            "distortion": list(camera.distortion),
            "depth_kind": dataset.first.depth_kind,
            "modulation_frequency_hz": dataset.first.modulation_frequency,
        },
        "held_out_error_mm": report["error_mm"]["after"]["test"],
    }
