"""The content of calibration.yaml: the calibration for people and other programs."""

import math
from collections.abc import Mapping
from typing import Any

import torch

from tofcorr.estimation.noise import DistanceNoise
from tofcorr.fit.result import Fit
from tofcorr.pixels.dataset import Dataset
from tofcorr.training.options import TrainingOptions
from tofcorr.training.report import number_or_none
from tofcorr.training.uncertainty import correction_curves


def calibration_mapping(
    data: Dataset,
    options: TrainingOptions,
    fit: Fit,
    report: Mapping[str, Any],
    noise: DistanceNoise | None,
) -> dict[str, Any]:
    """Return the content of calibration.yaml.

    Args:
        data: The recordings.
        options: Those of the training.
        fit: The fitted model.
        report: The content of report.json.
        noise: The noise of a measured distance; None if unknown.
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
            "width": camera.width,
            "height": camera.height,
            "K": [list(row) for row in camera.matrix],
            "distortion": list(camera.distortion),
            "depth_kind": data.first.depth_kind,
            "modulation_frequency_hz": data.first.modulation_frequency,
        },
        "held_out_error_mm": report["error_mm"]["after"]["test"],
        "noise": None if noise is None else noise.to_mapping(),
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
