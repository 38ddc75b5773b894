"""The fit of a module to recordings: moments and L-BFGS, as `tofcorr train` does it."""

import math
from collections.abc import Mapping, Sequence

import numpy as np

from tofcorr.correction.state import CalibrationState
from tofcorr.estimation.solvers import Watcher
from tofcorr.module.report import ErrorMM, FitReport
from tofcorr.pixels.dataset import Dataset, resolved_planes, split_frames
from tofcorr.pixels.metrics import FrameErrors
from tofcorr.pixels.sample import usable_pixels
from tofcorr.plausibility.examine import vet
from tofcorr.training import report as reporting
from tofcorr.training.calibration import calibrate
from tofcorr.training.judgement import against_garbage, frames_left_out, warnings
from tofcorr.training.options import TrainingOptions
from tofcorr.training.report import hand_eye_summary
from tofcorr.training.result import calibration_state
from tofcorr.training.support import recording_support


def fit_to(
    dataset: Dataset, options: TrainingOptions, watcher: Watcher | None, *, force: bool = False
) -> tuple[CalibrationState, FitReport]:
    """Split the frames, fit, and measure the error of the frames held out.

    Args:
        dataset: The recordings.
        options: Terms, solver, weights, split.
        watcher: Called after each iteration; returning False interrupts the solver.
        force: Fit whatever the recordings look like.

    Returns:
        The calibration, and the summary for the user.

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
    hand_eye = hand_eye_summary(result, dataset.first.frame_names)
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
    return calibration_state(found.data, options, result), report


def _error(
    errors: Mapping[str, FrameErrors], stage: str, frames: Sequence[int] | np.ndarray
) -> ErrorMM:
    numbers = np.asarray(frames)
    if not len(numbers):
        return ErrorMM(mean_abs=math.nan, rms=math.nan)
    found = errors[stage]
    return ErrorMM(mean_abs=found.mean_abs_mm(numbers), rms=found.rms_mm(numbers))
