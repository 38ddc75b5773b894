"""The fit of a module to recordings: moments and L-BFGS, as `tofcorr train` does it."""

import math
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from torch import Tensor

from tofcorr.correction.hand_eye_accuracy import HandEyeAccuracy
from tofcorr.correction.model import CalibrationModel
from tofcorr.error_terms.domain import Domain
from tofcorr.error_terms.model import ErrorModelOptions
from tofcorr.estimation.solvers import Watcher
from tofcorr.geometry.camera import FrameNames
from tofcorr.module.report import ErrorMM, FitReport
from tofcorr.pixels.dataset import Dataset, resolved_planes, split_frames
from tofcorr.pixels.masks import usable_pixels
from tofcorr.pixels.metrics import FrameErrors
from tofcorr.plausibility.examine import vet
from tofcorr.training import report as reporting
from tofcorr.training.calibration import calibrate
from tofcorr.training.judgement import against_garbage, frames_left_out, warnings
from tofcorr.training.options import TrainingOptions
from tofcorr.training.report import hand_eye_accuracy, hand_eye_summary
from tofcorr.training.support import recording_support


class Fitted(NamedTuple):
    """A fit, in the form that the module takes over.

    Attributes:
        model: The error model, float64, and the hand-eye transform.
        terms: Its terms, with what was found in the data.
        domain: The ranges of the frames fitted.
        tool_from_camera: The hand-eye transform, shape (4, 4), float64, metres.
        hand_eye_estimated: Whether it was estimated, or known beforehand.
        covariance: Of the coefficients, shape (K, K), float64, square metres.
        noise: Of a measured distance, as in `CalibrationState`; None if unknown.
        frames: What the recordings call the coordinate frames.
        hand_eye_accuracy: Standard errors of `tool_from_camera`; None if it was not estimated.
        report: The summary for the user.
    """

    model: CalibrationModel
    terms: ErrorModelOptions
    domain: Domain
    tool_from_camera: Tensor
    hand_eye_estimated: bool
    covariance: Tensor
    noise: tuple[float, float, float] | None
    frames: FrameNames
    hand_eye_accuracy: HandEyeAccuracy | None
    report: FitReport


def fit_to(
    dataset: Dataset, options: TrainingOptions, watcher: Watcher | None, *, force: bool = False
) -> Fitted:
    """Split the frames, fit, and measure the error of the frames held out.

    Args:
        dataset: The recordings.
        options: Terms, solver, weights, split.
        watcher: Called after each iteration; returning False interrupts the solver.
        force: Fit whatever the recordings look like.

    Raises:
        CalibrationDataError: The data cannot support the model, or cannot be what they say.
    """
    planes = resolved_planes(options.planes, dataset.recordings)
    inspection = vet(dataset, planes, force=force)
    options = against_garbage(options, inspection)
    left_out = frames_left_out(inspection, [split_frames(dataset, options.split)[0]])
    dataset = usable_pixels(
        dataset,
        options,
        robust=options.weights.robust != "none",
        frames=split_frames(dataset, options.split)[0],
    )
    found = calibrate(dataset, options, watcher, left_out=left_out)
    result, training, test, errors = found.fit, found.train, found.test, found.errors
    measured = test if len(test) else training
    summary = reporting.error_summary(errors, training, test)
    best = result.solution.parameters
    support = recording_support(found.data, training, best.tool_from_camera)
    frames = dataset.first.frame_names
    hand_eye = hand_eye_summary(result, frames)
    noise_mm = 1e3 * inspection.look.sample.noise_rms
    report = FitReport(
        model=options.name,
        before=_error(errors, "before", measured),
        hand_eye_only=_error(errors, "hand_eye_only", measured),
        after=_error(errors, "after", measured),
        held_out=bool(len(test)),
        tool_from_camera=tuple(tuple(row) for row in hand_eye["tool_from_camera"]),
        translation_se_mm=tuple(hand_eye["translation_se_mm"]),
        rotation_se_deg=tuple(hand_eye["rotation_se_deg"]),
        stopped=result.solution.stopped,
        iterations=result.solution.iterations,
        train_frames=tuple(training.tolist()),
        test_frames=tuple(test.tolist()),
        warnings=(
            *([inspection.headline] if inspection.headline else []),
            *warnings(result, summary, support, noise_mm, robot_moves=found.data.moves),
        ),
    )
    return Fitted(
        model=result.model,
        terms=result.options,
        domain=result.domain,
        tool_from_camera=best.tool_from_camera,
        hand_eye_estimated=best.hand_eye_is_free,
        covariance=result.covariance.matrix[best.twist_size :, best.twist_size :],
        noise=None if result.noise is None else result.noise.coefficients,
        frames=frames,
        hand_eye_accuracy=hand_eye_accuracy(result),
        report=report,
    )


def _error(
    errors: Mapping[str, FrameErrors], stage: str, frames: Sequence[int] | np.ndarray
) -> ErrorMM:
    numbers = np.asarray(frames)
    if not len(numbers):
        return ErrorMM(mean_abs=math.nan, rms=math.nan)
    found = errors[stage]
    return ErrorMM(mean_abs=found.mean_abs_mm(numbers), rms=found.rms_mm(numbers))
