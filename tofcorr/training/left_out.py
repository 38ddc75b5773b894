"""What a training leaves out by itself: single wrong poses, and pixels far off their wall."""

from collections.abc import Iterable, Sequence
from typing import Any, TypeVar

import numpy as np

from tofcorr.plausibility.checks.garbage import FAR_OFF
from tofcorr.plausibility.finding import in_words
from tofcorr.plausibility.inspection import Inspection
from tofcorr.training.options import TrainingOptions

Training = TypeVar("Training", bound=TrainingOptions)

# Fewest frames left to fit on: as `pixels.split` asks for, and one more.
_FEWEST_FRAMES = 4


def against_garbage(options: Training, inspection: Inspection) -> Training:
    """Return the options with robust weights and the largest plane, where garbage spoils a fit.

    Only where the options leave the choice of pixels to the recording.
    """
    chosen = options.mask != "recording" or options.outlier_window_mm is not None
    if not inspection.garbage_bends or chosen or options.weights.robust != "none":
        return options
    weights = options.weights.model_copy(update={"robust": "cauchy"})
    return options.model_copy(
        update={"mask": "ransac", "mask_tolerance_mm": 1e3 * FAR_OFF, "weights": weights}
    )


def frames_left_out(inspection: Inspection, training: Iterable[np.ndarray]) -> tuple[int, ...]:
    """Return the frames that disagree with all others; none where too few would be left.

    Args:
        inspection: What was odd about the recordings.
        training: Global numbers of the frames to fit, an array a fit.
    """
    frames = tuple(inspection.outlying)
    enough = all((~np.isin(own, frames)).sum() >= _FEWEST_FRAMES for own in training)
    return frames if enough else ()


def left_out_words(frames: Sequence[int]) -> list[str]:
    """Return one sentence about frames left out; none if there is none."""
    if not frames:
        return []
    verb = "is" if len(frames) == 1 else "are"
    return [
        f"{in_words(tuple(frames)).capitalize()} {verb} left out of all fits and of the errors, as "
        "in a training: poses, planes or images disagree with all others."
    ]


def left_out_mapping(frames: Iterable[int], inspection: Inspection) -> list[dict[str, Any]]:
    """Return frames left out and by how much they disagree, the worst first: plain values."""
    chosen = set(frames)
    return [
        {"frame": frame, "off_mm": 1e3 * off}
        for frame, off in inspection.outlying.items()
        if frame in chosen
    ]
