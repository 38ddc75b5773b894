"""Calibration recovers a known camera, and says how well."""

import numpy as np
import pytest
from importing.checkerboard.rendered_board import (
    BOARD,
    CAMERA,
    placement,
    project,
    varied_placements,
)

from tofcorr.errors import CalibrationDataError
from tofcorr.importing.checkerboard.boards import calibrate, calibration_warning

SIZE = (CAMERA.width, CAMERA.height)


def noisy_corners(count: int) -> list[np.ndarray]:
    generator = np.random.default_rng(11)
    return [project(w) + generator.normal(0, 0.05, (35, 2)) for w in varied_placements(count)]


@pytest.mark.parametrize("astray", [{}, {(3, 7): 5.0, (9, 30): -4.0}])
def test_a_known_camera_is_recovered_within_its_stated_deviations(
    astray: dict[tuple[int, int], float],
) -> None:
    corners = noisy_corners(20)
    for (view, corner), off in astray.items():
        corners[view][corner] += off
    camera, about = calibrate(corners, BOARD, SIZE)
    off = np.array(camera.matrix) - np.array(CAMERA.matrix)
    deviations = np.array(about["standard_deviations"][:4])
    assert np.all(np.abs([off[0, 0], off[1, 1], off[0, 2], off[1, 2]]) < 4 * deviations)
    assert np.all(deviations < 2.0)
    assert about["outlying_corners"] == len(astray)
    # Two coordinates of 0.05 px each, less the degrees of freedom taken by the fit.
    assert about["reprojection_rms_px"] == pytest.approx(0.05 * np.sqrt(2), rel=0.15)
    slope = 1e3 * deviations[0] / camera.matrix[0][0]
    assert f"{slope:.1f} mm/m" in calibration_warning(camera, about)


def test_too_few_views_and_views_without_tilt_are_refused() -> None:
    with pytest.raises(CalibrationDataError, match="3 views show the board; at least 5"):
        calibrate(noisy_corners(3), BOARD, SIZE)
    generator = np.random.default_rng(5)
    views = [placement(distance) for distance in np.linspace(0.5, 0.8, 6)]
    corners = [project(view) + generator.normal(0, 0.05, (35, 2)) for view in views]
    with pytest.raises(CalibrationDataError, match="tilt it about both axes"):
        calibrate(corners, BOARD, SIZE)
