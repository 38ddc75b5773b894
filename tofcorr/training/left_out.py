"""What a training leaves out by itself: single wrong poses, and pixels far off their wall."""

import numpy as np

from tofcorr.pixels.dataset import Dataset
from tofcorr.pixels.split import split_frames
from tofcorr.plausibility.checks.garbage import FAR_OFF
from tofcorr.plausibility.inspection import Inspection
from tofcorr.training.options import TrainingOptions

# Fewest frames left to fit on: as `pixels.split` asks for, and one more.
_FEWEST_FRAMES = 4


def against_garbage(options: TrainingOptions, inspection: Inspection) -> TrainingOptions:
    """Return the options with robust weights and the largest plane, where garbage bends a fit.

    Only where the options leave the choice of pixels to the recording.
    """
    chosen = options.mask != "recording" or options.outlier_window_mm is not None
    if not inspection.garbage_bends or chosen or options.weights.robust != "none":
        return options
    weights = options.weights.model_copy(update={"robust": "cauchy"})
    return options.model_copy(
        update={"mask": "ransac", "mask_tolerance_mm": 1e3 * FAR_OFF, "weights": weights}
    )


def frames_left_out(
    data: Dataset, options: TrainingOptions, inspection: Inspection
) -> tuple[int, ...]:
    """Return the frames that disagree with all others; none where too few would be left."""
    frames = tuple(inspection.outlying)
    train, _ = split_frames(data, options.split)
    return frames if (~np.isin(train, frames)).sum() >= _FEWEST_FRAMES else ()
