"""The fit of a module to recordings, as `tofcorr train` does it, and what it found."""

import math
from dataclasses import dataclass

from pydantic import TypeAdapter

from tofcorr.correction.state import CalibrationState
from tofcorr.estimation.solvers import Watcher
from tofcorr.pixels.dataset import Dataset
from tofcorr.training.calibration import Calibration, TrainingOptions
from tofcorr.training.judgement import report_text
from tofcorr.training.report import training_report
from tofcorr.training.run import calibration_state, inspected


@dataclass(frozen=True, kw_only=True)
class ErrorMM:
    """Distances of points to their planes, millimetres; NaN without frames.

    Attributes:
        mean_abs: Mean absolute distance.
        rms: Root mean square distance.
    """

    mean_abs: float
    rms: float


@dataclass(frozen=True, kw_only=True, repr=False)
class FitReport:
    """What `DepthCorrection.fit` found; printing it gives the summary.

    Attributes:
        model: The model's name.
        before: Error of held-out frames as recorded, with the recorded hand-eye transform.
        hand_eye_only: The same with the best hand-eye transform and no depth correction.
        after: The same with hand-eye transform and depth correction.
        held_out: Whether the errors are of held-out frames; if not, of the frames fitted.
        tool_from_camera: The hand-eye transform, 4 rows of 4, metres.
        translation_se_mm: Its standard errors along the tool's axes, millimetres.
        rotation_se_deg: Its standard errors about the tool's axes, degrees.
        stopped: Why the solver stopped; only "converged" is convergence.
        iterations: How many iterations it took.
        train_frames: Numbers of the frames fitted.
        test_frames: Numbers of the frames held out.
        warnings: What to know before the result is trusted, one sentence each.
        text: All of it as lines, with a verdict.
    """

    model: str
    before: ErrorMM
    hand_eye_only: ErrorMM
    after: ErrorMM
    held_out: bool
    tool_from_camera: tuple[tuple[float, ...], ...]
    translation_se_mm: tuple[float, ...]
    rotation_se_deg: tuple[float, ...]
    stopped: str
    iterations: int
    train_frames: tuple[int, ...]
    test_frames: tuple[int, ...]
    warnings: tuple[str, ...]
    text: str

    def __repr__(self) -> str:
        """Return what `tofcorr train` prints."""
        return self.text


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
    dataset, options, inspection, left_out = inspected(dataset, options, force=force)
    found = Calibration(dataset, options, watcher, left_out=left_out)
    told = training_report(found, options.model_copy(update={"advice": 0}), inspection)
    half = "test" if len(found.test) else "train"
    errors = {
        stage: {name: math.nan if one is None else one for name, one in halves[half].items()}
        for stage, halves in told["error_mm"].items()
    }
    values = {
        **told,
        **told["hand_eye"],
        **errors,
        "held_out": half == "test",
        "train_frames": told["frames"]["train"],
        "test_frames": told["frames"]["test"],
        "warnings": [*filter(None, [inspection.headline]), *told["warnings"]],
        "text": report_text(told),
    }
    report = TypeAdapter(FitReport).validate_python(values)
    return calibration_state(found.data, options, found.fit), report
