"""The numbers that a training stands for: report.json and calibration.yaml."""

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from torch import Tensor

from tofcorr.estimation.objective import MomentObjective
from tofcorr.estimation.observability import observability
from tofcorr.estimation.parameters import Parameters
from tofcorr.training.dataset import Dataset
from tofcorr.training.fitting import Fit
from tofcorr.training.metrics import FrameErrors

STAGES = ("before", "hand_eye_only", "after")

# Below this many training images the standard errors themselves are uncertain by a quarter.
_FEW_IMAGES = 10


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


def warnings(fit: Fit, dataset: Dataset, errors: Mapping[str, Any]) -> list[str]:
    """Return what a user must know before trusting the result, one sentence each."""
    found: list[str] = []
    if not fit.solution.converged:
        found.append(fit.solution.message)
    if fit.moments.num_images < _FEW_IMAGES:
        found.append(
            f"Only {fit.moments.num_images} images were fitted; standard errors are rough below "
            f"{_FEW_IMAGES}."
        )
    open_questions = observability(fit.moments, fit.solution.parameters)
    found += [
        f"These images leave a direction free: {' with '.join(names)}. Their values are arbitrary "
        "along it; add tilted views or hold the hand-eye."
        for names in open_questions.free
    ]
    found += [
        f"{pair.first} and {pair.second} are hardly told apart (correlation "
        f"{pair.correlation:+.3f}): only their combination is known."
        for pair in open_questions.confounded
        if _crosses_over(pair.first, pair.second)
    ]
    found += _overfitting(errors)
    if not dataset.moves:
        found.append("No robot pose changes: the hand-eye transform is held at the identity.")
    return found


def image_misfit(fit: Fit, parameters: Parameters) -> Tensor:
    """Return each fitted image's RMS distance to its plane, shape (N,), metres."""
    losses = MomentObjective(fit.moments).image_losses(parameters).clamp(min=0)
    return (losses / fit.moments.count.clamp(min=1)).sqrt()


def _crosses_over(first: str, second: str) -> bool:
    """Whether a hand-eye parameter is mistaken for an error coefficient."""
    return (first[:2] in ("t_", "w_")) != (second[:2] in ("t_", "w_"))


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
