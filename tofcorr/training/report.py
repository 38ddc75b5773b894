"""The content of report.json and calibration.yaml: a training in numbers."""

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from torch import Tensor

from tofcorr.conditions import CONDITIONS
from tofcorr.correction.state import HandEyeAccuracy
from tofcorr.error_terms.model import Pixels
from tofcorr.estimation.moments import HAND_EYE_SYMBOLS
from tofcorr.estimation.robust import outlying_images, student_quantile
from tofcorr.fit.problem import Fit
from tofcorr.geometry.camera import FrameNames
from tofcorr.pixels.dataset import Dataset
from tofcorr.pixels.passes import FrameErrors, views_mm
from tofcorr.plausibility.finding import Inspection
from tofcorr.training.advice import advise, draw_pool
from tofcorr.training.calibration import Calibration, TrainingOptions
from tofcorr.training.judgement import expected, judge, left_out_mapping
from tofcorr.training.support import Support
from tofcorr.version import __version__


def hand_eye_covariance(fit: Fit) -> Tensor:
    """Return the covariance of translation and rotation, shape (6, 6), metres and radians.

    It is along the tool's axes: by leaving out one pose at a time, with what is left of the noise's
    shift, and the shift by an error that the model lacks.
    """
    turn = torch.block_diag(*[fit.solution.parameters.tool_from_camera[:3, :3]] * 2)
    return turn @ fit.hand_eye_covariance @ turn.T


def hand_eye_errors(fit: Fit) -> Tensor:
    """Return the standard errors of translation and rotation, shape (2, 3), metres and radians."""
    return hand_eye_covariance(fit).diagonal().clamp(min=0).sqrt().view(2, 3)


def _in_units(values: Tensor, kind: str) -> dict[str, Any]:
    """Return values of translation and rotation (2, 3) in millimetres and degrees, by name."""
    return {
        f"translation_{kind}_mm": (1e3 * values[0]).tolist(),
        f"rotation_{kind}_deg": torch.rad2deg(values[1]).tolist(),
    }


def hand_eye_accuracy(fit: Fit) -> HandEyeAccuracy | None:
    """Return how well a fit knows the hand-eye transform; None if it was not estimated."""
    if not fit.solution.parameters.hand_eye_is_free:
        return None
    free, known = fit.observability.undetermined, _in_units(hand_eye_errors(fit), "se")
    known["undetermined"] = [x.in_words() for x in free if {*x.shares} & {*HAND_EYE_SYMBOLS}]
    return HandEyeAccuracy.model_validate(known)


def hand_eye_summary(fit: Fit, frames: FrameNames) -> dict[str, Any]:
    """Return the hand-eye transform with standard errors and 95 % intervals along the tool's axes.

    `covariance_mm_deg` (6, 6) is that of the translation, then of the rotation.

    Args:
        fit: The fitted model.
        frames: What the recording calls the frames; `tool` carries the camera.
    """
    transform, shift, known = fit.solution.parameters.tool_from_camera, None, hand_eye_accuracy(fit)
    if fit.noise_shift is not None:
        shift = fit.noise_shift.to_mapping(transform[:3, :3]) | {"removed": fit.noise_shift.removed}
    # Student's t, with the poses less one as degrees of freedom: a fortieth lies beyond each end.
    half_width = student_quantile(39 / 40, fit.covariance.degrees_of_freedom)
    exact = HandEyeAccuracy.model_validate(_in_units(torch.zeros(2, 3), "se"))
    uncertain: dict[str, Any] = {}
    if known is not None:
        units = torch.tensor([1e3] * 3 + [math.degrees(1)] * 3, dtype=torch.float64)
        uncertain = _in_units(half_width * hand_eye_errors(fit), "ci95")
        uncertain["covariance_mm_deg"] = (
            units[:, None] * hand_eye_covariance(fit) * units
        ).tolist()
    return {
        "tool_from_camera": transform.tolist(),
        "estimated": known is not None,
        **(known or exact).model_dump(mode="json"),
        "noise_shift": shift,
        "frames": frames.to_mapping(),
        **uncertain,
    }


def correction_curves(fit: Fit) -> dict[str, list[dict[str, float]]]:
    """Return the predicted error with its standard error over the calibrated ranges.

    The curves are those of the image's centre. Along `distance` the amplitude is the one typical of
    each distance (the middle of A D^2, within the calibrated range); along `amplitude` the distance
    is the middle one. A curve may be known well although its coefficients are not.
    """
    domain, points = fit.domain, 21
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
    parameters, error = fit.solution.parameters, fit.model.error
    sizes = error.height, error.width
    row, column = (torch.full_like(distance, (size - 1) / 2) for size in sizes)
    conditions = torch.zeros(len(distance), len(CONDITIONS)).to(distance)
    # Condition terms come last; they are zero at the mean conditions.
    known, at = len(error.image_symbols()), Pixels(distance, amplitude, row, column, conditions)
    basis = error.columns_at(at).detach()[:known].T
    own = slice(parameters.twist_size, parameters.twist_size + known)
    predicted = basis @ parameters.coefficients[:known]
    variance = ((basis @ fit.covariance.matrix[own, own]) * basis).sum(dim=1)
    quantities = (distance, amplitude, 1e3 * predicted, 1e3 * variance.clamp(min=0).sqrt())
    names = ("radial_distance_m", "amplitude", "error_mm", "standard_error_mm")
    return [dict(zip(names, row, strict=True)) for row in torch.stack(quantities, dim=1).tolist()]


def training_report(
    calibration: Calibration, options: TrainingOptions, inspection: Inspection
) -> dict[str, Any]:
    """Return the content of report.json: plain values; errors are in millimetres.

    Args:
        calibration: The fitted model and its errors.
        options: Those of the training; the seed of the split also seeds the advice.
        inspection: What was odd about the recordings.
    """
    fit, data, seed = calibration.fit, calibration.data, options.split.seed
    solution, after = fit.solution, calibration.errors["after"]
    hand_eye = solution.parameters.tool_from_camera
    support = Support(data, calibration.train, hand_eye)
    errors = error_summary(calibration.errors, calibration.train, calibration.test)
    verdict, reason, found = judge(fit, errors, support, inspection)
    rms = np.sqrt(after.squared / np.maximum(after.count, 1))
    random = np.random.default_rng(seed)
    pool = draw_pool(data, calibration.train, fit, random) if options.advice else None
    return {
        "format": "tofcorr-report",
        "version": 1,
        "tofcorr": __version__,
        "model": options.name,
        "stopped": solution.stopped,
        "message": solution.message,
        "verdict": verdict,
        "reason": reason,
        "expected": expected(fit, errors, inspection),
        "headline": inspection.headline,
        "iterations": solution.iterations,
        "hand_eye": hand_eye_summary(fit, data.first.frame_names),
        "error_mm": errors,
        "views_mm": {
            half: {k: number_or_none(own) for k, own in views_mm(calibration.kinds, frames).items()}
            for half, frames in (("train", calibration.train), ("test", calibration.test))
        },
        "recordings": [str(one.path.resolve()) for one in data.recordings],
        "frames": {"train": calibration.train.tolist(), "test": calibration.test.tolist()},
        "assumptions": [
            {"name": one.cause, "error": one.words, **one.to_mapping(hand_eye[:3, :3])}
            for one in fit.assumptions
        ],
        "misfit": (lacking := fit.misfit)
        and {
            "probe": lacking.cause,
            "residuals": lacking.words,
            "p_value": lacking.p_value,
            **lacking.to_mapping(hand_eye[:3, :3]),
        },
        "left_out": left_out_mapping({*inspection.outlying} - {*calibration.frames}, inspection),
        "weights": None if fit.weights is None else fit.weights.to_mapping(),
        "walls": None if fit.walls is None else fit.walls.summary(),
        "outlying_images": outlying_images(after.frames, rms),
        "observability": observability_summary(fit, support),
        "advice": None if pool is None else advise(data, pool, fit, options.advice)[1],
        "plausibility": [one.to_mapping() for one in inspection.findings],
        "warnings": [*found, *inspection.notes],
    }


def error_summary(
    errors: Mapping[str, FrameErrors], train: np.ndarray, test: np.ndarray
) -> dict[str, Any]:
    """Return mean absolute and RMS error of each stage on both halves; null on an empty half."""
    halves = {"train": train, "test": test}.items()
    kinds = {"mean_abs": FrameErrors.mean_abs_mm, "rms": FrameErrors.rms_mm}.items()
    return {
        stage: {
            half: {kind: number_or_none(of(measured, own)) for kind, of in kinds}
            for half, own in halves
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
            for direction in fit.directions[:5]
        ],
        "confounded": [
            {"first": first, "second": second, "correlation": correlation}
            for (first, second), correlation in fit.observability.confounded.items()
        ],
        "prior": [] if fit.prior is None else fit.prior.names,
        "support": support.to_mapping(),
    }


def number_or_none(value: float) -> float | None:
    """Return the number, or None where it is not finite: JSON has neither NaN nor infinity."""
    return value if math.isfinite(value) else None


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
        "noise": None if fit.noise is None else fit.noise._asdict(),
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

    def error_of(group: str, symbol: str) -> float | None:
        """Return the jackknife's standard error; None if a value is unknown."""
        known = np.array([one[group].get(symbol, np.nan) for one in shifted])
        variance = (len(known) - 1) * np.mean(np.square(known - known.mean()))
        return number_or_none(float(np.sqrt(variance)))

    return {
        group: {
            symbol: {"value": number_or_none(value), "standard_error": error_of(group, symbol)}
            for symbol, value in named.items()
        }
        for group, named in values.items()
    }
