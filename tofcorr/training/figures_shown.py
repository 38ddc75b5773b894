"""What TensorBoard shows of the pixels of a run: curves, distributions and error images.

None of it is drawn by Matplotlib, which takes longer than a short fit. `plot_profile` of a
`TrainingResult`, and its neighbours, draw the same with labelled axes.
"""

import math
from collections.abc import Iterator

import numpy as np

from tofcorr.pixels.pixel_sample import PixelSample, sample_pixels
from tofcorr.training.calibration import Calibration
from tofcorr.training.error_pictures import error_picture
from tofcorr.training.profiles import ends_of, profile
from tofcorr.training.shown import error_images, frames_to_show

# TensorBoard counts steps in whole numbers, so a covariate is multiplied by a power of ten until
# its range has at least so many steps. Chosen: bins stay apart.
_LEAST_STEPS = 300


def pixels_shown(calibration: Calibration) -> PixelSample:
    """Return the sample of pixels that curves and distributions come from."""
    frames = np.sort(np.concatenate([calibration.train, calibration.test]))
    return sample_pixels(calibration.data, calibration.stages, frames)


def curves(calibration: Calibration, sample: PixelSample) -> Iterator[tuple[str, int, float]]:
    """Yield tag, step and value of the mean error over each covariate, mm.

    The step is the covariate, multiplied by the power of ten that the tag names.
    """
    tested = np.isin(sample.frame, calibration.test)
    for covariate, x in sample.covariates.items():
        low, high = ends = ends_of(x)
        power = max(math.ceil(math.log10(_LEAST_STEPS / max(high - low, 1e-9))), 0)
        name = covariate.split(" [")[0].replace(" ", "_")
        name += f"_x{10**power}" if power else ""
        shown = {stage: (x, error) for stage, error in sample.errors_mm.items()}
        if tested.any() and "after" in shown:
            shown["after_held_out"] = x[tested], sample.errors_mm["after"][tested]
        for stage, (at, error) in shown.items():
            found = profile(at, error, ends)
            steps = np.round(found.middle * 10**power).astype(int).tolist()
            for step, mean in zip(steps, found.mean.tolist(), strict=True):
                yield f"error_mm_against/{name}/{stage}", step, mean


def distributions(
    calibration: Calibration, sample: PixelSample
) -> Iterator[tuple[str, np.ndarray]]:
    """Yield tag and values of the errors at each stage, mm, of fitted and of held-out frames."""
    tested = np.isin(sample.frame, calibration.test)
    for stage, errors in sample.errors_mm.items():
        for half, chosen in (("fitted", ~tested), ("held_out", tested)):
            known = errors[chosen & np.isfinite(errors)]
            if len(known):
                yield f"error_mm/{stage}_{half}", known


def drawn(calibration: Calibration) -> tuple[np.ndarray, str]:
    """Return the error images of some frames, (H, W, 3), uint8, and what they show."""
    return error_picture(*error_images(calibration, frames_to_show(calibration)))
