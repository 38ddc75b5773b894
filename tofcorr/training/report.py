"""The content of report.json: a training in numbers."""

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
import torch

from tofcorr.estimation.statistics import outlying_images
from tofcorr.fit.result import Fit
from tofcorr.fit.unknown_walls import wall_summary
from tofcorr.pixels.metrics import FrameErrors
from tofcorr.plausibility.inspection import Inspection
from tofcorr.training.calibration import Calibration
from tofcorr.training.hand_eye import assumptions_summary, hand_eye_summary
from tofcorr.training.left_out import left_out_mapping
from tofcorr.training.next_poses import advise, draw_pool
from tofcorr.training.options import TrainingOptions
from tofcorr.training.support import Support, recording_support
from tofcorr.training.uncertainty import bootstrap_summary, interval_summary
from tofcorr.training.verdict import judge
from tofcorr.training.warning_texts import warnings
from tofcorr.version import __version__

# How many of the weakest directions the report lists. Set by hand.
_WEAKEST = 5


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
    noise_mm = 1e3 * inspection.look.sample.noise_rms
    found = warnings(fit, errors, support, noise_mm, robot_moves=data.moves)
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
        "hand_eye": hand_eye_summary(fit, data.first.frame_names) | interval_summary(fit),
        "error_mm": errors,
        "frames": {"train": calibration.train.tolist(), "test": calibration.test.tolist()},
        "assumptions": assumptions_summary(fit),
        "misfit": _misfit(fit),
        "left_out": left_out_summary(calibration, inspection),
        "weights": weight_summary(fit),
        "walls": None if fit.walls is None else wall_summary(fit.walls.names, fit.walls.walls),
        "outlying_images": outlier_summary(calibration.errors["after"]),
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
            for direction in fit.observability.directions[:_WEAKEST]
        ],
        "confounded": [pair._asdict() for pair in fit.observability.confounded],
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


def outlier_summary(errors: FrameErrors) -> list[dict[str, Any]]:
    """Return the images whose error is much larger than that of the others, the largest first."""
    rms = np.sqrt(errors.squared / np.maximum(errors.count, 1))
    return [outlier._asdict() for outlier in outlying_images(errors.frames, rms)]


def left_out_summary(calibration: Calibration, inspection: Inspection) -> list[dict[str, Any]]:
    """Return the frames that disagree with all others and were neither fitted nor held out."""
    used = set(calibration.train.tolist()) | set(calibration.test.tolist())
    return left_out_mapping(set(inspection.outlying) - used, inspection)


def number_or_none(value: float) -> float | None:
    """Return the number, or None where it is not finite: JSON has no NaN."""
    return value if math.isfinite(value) else None


def _misfit(fit: Fit) -> dict[str, Any] | None:
    if fit.misfit is None:
        return None
    return fit.misfit.to_mapping(fit.solution.parameters.tool_from_camera[:3, :3])


def _advice(calibration: Calibration, options: TrainingOptions) -> dict[str, Any] | None:
    """Return which poses to add; None if the options ask for none, or if none was found."""
    if not options.advice:
        return None
    generator = np.random.default_rng(options.split.seed)
    pool = draw_pool(calibration.data, calibration.train, calibration.fit, generator)
    if pool is None:
        return None
    return advise(calibration.data, pool, calibration.fit, options.advice)[1]
