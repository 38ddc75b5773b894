"""The content of report.json and calibration.yaml: a training in numbers."""

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from torch import Tensor

from tofcorr.correction.state import HandEyeAccuracy
from tofcorr.error_terms.model import ErrorModel
from tofcorr.errors import CalibrationDataError
from tofcorr.estimation.moments import HAND_EYE_SYMBOLS
from tofcorr.estimation.robust import outlying_images, student_quantile
from tofcorr.estimation.uncertainty import bootstrap, draw_block_weights
from tofcorr.fit.result import Fit
from tofcorr.fit.walls import wall_summary
from tofcorr.geometry.camera import FrameNames
from tofcorr.pixels.dataset import Dataset
from tofcorr.pixels.metrics import FrameErrors
from tofcorr.plausibility.finding import Inspection
from tofcorr.training.advice import advise, draw_pool
from tofcorr.training.calibration import Calibration
from tofcorr.training.judgement import judge, left_out_mapping, warnings
from tofcorr.training.options import TrainingOptions
from tofcorr.training.support import Support, recording_support
from tofcorr.version import __version__


def hand_eye_errors(fit: Fit) -> tuple[Tensor, Tensor]:
    """Return the standard errors of translation (3,) and rotation (3,), metres and radians.

    They are along the tool's axes: by leaving out one pose at a time, with what is left of the
    noise's shift, and the shift by an error that the model lacks.
    """
    rotation, matrix = fit.solution.parameters.tool_from_camera[:3, :3], fit.hand_eye_covariance
    blocks = matrix[:3, :3], matrix[3:6, 3:6]
    first, second = (
        (rotation @ block @ rotation.T).diagonal().clamp(min=0).sqrt() for block in blocks
    )
    return first, second


def hand_eye_intervals(fit: Fit, level: float = 0.95) -> tuple[Tensor, Tensor]:
    """Return the half-widths of the intervals of translation and rotation, each (3,).

    The standard errors of `hand_eye_errors` times the t distribution's quantile. Its degrees of
    freedom are the poses less one.
    """
    quantile = student_quantile((1 + level) / 2, fit.covariance.degrees_of_freedom)
    translation, rotation = hand_eye_errors(fit)
    return quantile * translation, quantile * rotation


def hand_eye_accuracy(fit: Fit) -> HandEyeAccuracy | None:
    """Return how well a fit knows the hand-eye transform; None if it was not estimated."""
    if not fit.solution.parameters.hand_eye_is_free:
        return None
    translation, rotation = hand_eye_errors(fit)
    return HandEyeAccuracy(
        translation_se_mm=tuple((1e3 * translation).tolist()),
        rotation_se_deg=tuple(rotation.rad2deg().tolist()),
        undetermined=tuple(
            direction.in_words()
            for direction in fit.observability.undetermined
            if set(direction.shares) & set(HAND_EYE_SYMBOLS)
        ),
    )


def hand_eye_summary(fit: Fit, frames: FrameNames) -> dict[str, Any]:
    """Return the hand-eye transform with standard errors and 95 % intervals along the tool's axes.

    Args:
        fit: The fitted model.
        frames: What the recording calls the frames; `tool` carries the camera.
    """
    transform, shift, known = fit.solution.parameters.tool_from_camera, None, hand_eye_accuracy(fit)
    if fit.noise_shift is not None:
        rotation, twist = transform[:3, :3], fit.noise_shift.twist
        shift = {
            "translation_mm": (1e3 * rotation @ twist[:3]).tolist(),
            "rotation_deg": torch.rad2deg(rotation @ twist[3:]).tolist(),
            "removed": fit.noise_shift.removed,
        }
    summary = {
        "tool_from_camera": transform.tolist(),
        "estimated": known is not None,
        "translation_se_mm": [0.0, 0.0, 0.0] if known is None else list(known.translation_se_mm),
        "rotation_se_deg": [0.0, 0.0, 0.0] if known is None else list(known.rotation_se_deg),
        "undetermined": [] if known is None else list(known.undetermined),
        "noise_shift": shift,
        "frames": frames.to_mapping(),
    }
    if known is not None:
        translation, turn = hand_eye_intervals(fit)
        summary["translation_ci95_mm"] = (1e3 * translation).tolist()
        summary["rotation_ci95_deg"] = torch.rad2deg(turn).tolist()
    return summary


def bootstrap_summary(
    fit: Fit, generator: torch.Generator, resamples: int = 1000
) -> dict[str, Any] | None:
    """Return standard errors from resamples of poses.

    None with too few poses, and where a resample leaves something undetermined.

    Args:
        fit: The fitted model.
        generator: Source of randomness.
        resamples: How many: a standard deviation of 1000 values is known to 2 %.
    """
    try:
        weights = draw_block_weights(fit.poses, resamples, generator)
    except CalibrationDataError:
        return None
    optimum = fit.optimum
    drawn = bootstrap(fit.moments, optimum, weights, fit.total_prior)
    if not bool(drawn.isfinite().all()):
        return None
    summary: dict[str, Any] = {"resamples": resamples, "poses": int(fit.poses.max()) + 1}
    if optimum.hand_eye_is_free:
        rotation = optimum.tool_from_camera[:3, :3]
        translation = 1e3 * (drawn[:, :3] @ rotation.T)
        turn = torch.rad2deg(drawn[:, 3:6] @ rotation.T)
        summary["translation_se_mm"] = translation.std(dim=0).tolist()
        summary["rotation_se_deg"] = turn.std(dim=0).tolist()
    return summary


def correction_curves(fit: Fit, points: int = 21) -> dict[str, list[dict[str, float]]]:
    """Return the predicted error with its standard error over the calibrated ranges.

    The curves are those of the image's centre. Along `distance` the amplitude is the one typical of
    each distance (the middle of A D^2, within the calibrated range); along `amplitude` the distance
    is the middle one. A curve may be known well although its coefficients are not.
    """
    domain = fit.domain
    middle = torch.full((points,), domain.radial_distance.centre, dtype=torch.float64)
    distance = torch.linspace(*domain.radial_distance, points, dtype=torch.float64)
    if domain.amplitude is None or domain.normalised_amplitude is None:
        return {"distance": _curve(fit, distance, torch.ones_like(distance))}
    typical = domain.normalised_amplitude.centre / distance.square()
    amplitude = torch.linspace(*domain.amplitude, points, dtype=torch.float64)
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


def training_report(
    calibration: Calibration, options: TrainingOptions, inspection: Inspection
) -> dict[str, Any]:
    """Return the content of report.json: plain values; errors are in millimetres.

    Args:
        calibration: The fitted model and its errors.
        options: Those of the training; the seed of the split also seeds bootstrap and advice.
        inspection: What was odd about the recordings.
    """
    fit, data = calibration.fit, calibration.data
    solution = fit.solution
    support = recording_support(data, calibration.train, solution.parameters.tool_from_camera)
    errors = error_summary(calibration.errors, calibration.train, calibration.test)
    generator = torch.Generator().manual_seed(options.split.seed)
    verdict, reason = judge(fit, errors, support, inspection)
    noise_mm = 1e3 * inspection.look.noise_rms
    found = warnings(fit, errors, support, noise_mm, robot_moves=data.moves)
    rotation = solution.parameters.tool_from_camera[:3, :3]
    used = {*calibration.train.tolist(), *calibration.test.tolist()}
    after = calibration.errors["after"]
    rms = np.sqrt(after.squared / np.maximum(after.count, 1))
    return {
        "format": "tofcorr-report",
        "version": 1,
        "tofcorr": __version__,
        "model": options.name,
        "stopped": solution.stopped,
        "message": solution.message,
        "verdict": verdict,
        "reason": reason,
        "headline": inspection.headline,
        "iterations": solution.iterations,
        "hand_eye": hand_eye_summary(fit, data.first.frame_names),
        "error_mm": errors,
        "frames": {"train": calibration.train.tolist(), "test": calibration.test.tolist()},
        "assumptions": [one.to_mapping(rotation) for one in fit.assumptions],
        "misfit": None if fit.misfit is None else fit.misfit.to_mapping(rotation),
        "left_out": left_out_mapping(set(inspection.outlying) - used, inspection),
        "weights": weight_summary(fit),
        "walls": None if fit.walls is None else wall_summary(fit.walls.names, fit.walls.walls),
        "outlying_images": [one._asdict() for one in outlying_images(after.frames, rms)],
        "bootstrap": bootstrap_summary(fit, generator),
        "observability": observability_summary(fit, support),
        "advice": _advice(calibration, options),
        "plausibility": [one.to_mapping() for one in inspection.findings],
        "warnings": [*found, *inspection.notes],
    }


def error_summary(
    errors: Mapping[str, FrameErrors], train: np.ndarray, test: np.ndarray
) -> dict[str, Any]:
    """Return mean absolute and RMS error of each stage on both halves; null on an empty half."""
    return {
        stage: {
            half: {
                "mean_abs": number_or_none(measured.mean_abs_mm(frames)),
                "rms": number_or_none(measured.rms_mm(frames)),
            }
            for half, frames in (("train", train), ("test", test))
        }
        for stage, measured in errors.items()
    }


def observability_summary(fit: Fit, support: Support) -> dict[str, Any]:
    """Return how well the images determine the unknowns, and what they cover."""
    return {
        "weakest": [
            {
                "direction": direction.in_words(),
                "sigma_mm_or_mrad": 1e3 * direction.sigma,
                "free": direction.is_undetermined,
                "components": direction.shares,
            }
            for direction in fit.observability.directions[:5]
        ],
        "confounded": [
            {"first": first, "second": second, "correlation": correlation}
            for (first, second), correlation in fit.observability.confounded.items()
        ],
        # JSON has no infinity.
        "condition": min(fit.observability.condition, 1e300),
        "prior": [] if fit.prior is None else fit.prior.names,
        "support": support.to_mapping(),
    }


def weight_summary(fit: Fit) -> dict[str, Any] | None:
    """Return how pixels were weighted; None if all had the same weight."""
    if fit.weights is None:
        return None
    noise = fit.weights.noise
    return {
        "noise": None if noise is None else noise.to_mapping(),
        "robust": fit.weights.loss,
        "scale_mm": None if fit.weights.model is None else 1e3 * fit.weights.scale,
    }


def number_or_none(value: float) -> float | None:
    """Return the number, or None where it is not finite: JSON has no NaN."""
    return value if math.isfinite(value) else None


def _advice(calibration: Calibration, options: TrainingOptions) -> dict[str, Any] | None:
    """Return which poses to add; None if the options ask for none, or if none was found."""
    if not options.advice:
        return None
    generator = np.random.default_rng(options.split.seed)
    pool = draw_pool(calibration.data, calibration.train, calibration.fit, generator)
    if pool is None:
        return None
    return advise(calibration.data, pool, calibration.fit, options.advice)[1]


def calibration_mapping(
    data: Dataset, options: TrainingOptions, fit: Fit, report: Mapping[str, Any]
) -> dict[str, Any]:
    """Return the content of calibration.yaml.

    Args:
        data: The recordings.
        options: Those of the training.
        fit: The fitted model.
        report: The content of report.json.
    """
    camera, domain = data.first.camera, fit.domain
    return {
        "format": "tofcorr-calibration",
        "version": 1,
        "model": options.name,
        "terms": fit.options.to_mapping()["terms"],
        "sign": "error = measured - true; corrected = measured - error",
        "units": "metres, pixels, and the camera's own amplitude units",
        "coefficients": coefficient_summary(fit),
        "correction_curves": correction_curves(fit),
        "hand_eye": report["hand_eye"],
        "validity": {
            "radial_distance_m": list(domain.radial_distance),
            "amplitude": None if domain.amplitude is None else list(domain.amplitude),
        },
        "camera": {
            **camera.section(),
            "depth_kind": data.first.depth_kind,
            "modulation_frequency_hz": data.first.modulation_frequency,
        },
        "held_out_error_mm": report["error_mm"]["after"]["test"],
        "noise": None if fit.noise is None else fit.noise.to_mapping(),
    }


def coefficient_summary(fit: Fit) -> dict[str, Any]:
    """Return the coefficients in the paper's symbols, each with its standard error.

    Units are metres, pixels and the camera's amplitude units. The standard errors leave out one
    pose at a time, through the conversion to the paper's form.
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
                "value": number_or_none(value),
                "standard_error": _jackknife_error([one[group].get(symbol) for one in shifted]),
            }
            for symbol, value in named.items()
        }
        for group, named in values.items()
    }


def _jackknife_error(values: list[float | None]) -> float | None:
    """Return the jackknife's standard error; None if a value is unknown."""
    given = [math.nan if value is None else value for value in values]
    known = torch.tensor(given, dtype=torch.float64)
    count = len(known)
    variance = (count - 1) / count * (known - known.mean()).square().sum()
    return number_or_none(float(variance.sqrt()))
