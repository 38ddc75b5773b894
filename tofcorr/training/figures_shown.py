"""The figures of a run that TensorBoard shows, drawn once each."""

from collections.abc import Iterator

import numpy as np

from tofcorr.pixels.pixel_sample import sample_pixels
from tofcorr.training.calibration import Calibration
from tofcorr.training.figures import pixels_of, points_figure, profile_figure, residual_figure
from tofcorr.training.shown import error_images, frames_to_show, points_on_plane


def drawn(calibration: Calibration) -> Iterator[tuple[str, np.ndarray]]:
    """Yield a tag and an image (H, W, 3), uint8, of every figure."""
    data, train, test = calibration.data, calibration.train, calibration.test
    sample = sample_pixels(data, calibration.stages, np.sort(np.concatenate([train, test])))
    for covariate in sample.covariates:
        name = covariate.split(" [")[0].replace(" ", "_")
        yield f"error_against/{name}", pixels_of(profile_figure(sample, covariate, test))
    chosen = frames_to_show(calibration)
    residuals = residual_figure(*error_images(calibration, chosen))
    yield "frames/error_before_and_after", pixels_of(residuals)
    points = points_figure(*points_on_plane(calibration, int(chosen[len(chosen) // 2])))
    yield "frames/points_before_and_after", pixels_of(points)
