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
from tofcorr.geometry.camera import CameraIntrinsics
from tofcorr.importing.checkerboard.pose import calibrate, calibration_warning

SIZE = (CAMERA.width, CAMERA.height)
TRUE = np.array(
    [CAMERA.matrix[0][0], CAMERA.matrix[1][1], CAMERA.matrix[0][2], CAMERA.matrix[1][2]]
)


def noisy_corners(count: int) -> list[np.ndarray]:
    generator = np.random.default_rng(11)
    return [project(w) + generator.normal(0, 0.05, (35, 2)) for w in varied_placements(count)]


def found_parameters(camera: CameraIntrinsics) -> np.ndarray:
    matrix = np.array(camera.matrix)
    return np.array([matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2]])


def test_a_known_camera_is_recovered_within_its_stated_deviations() -> None:
    camera, about = calibrate(noisy_corners(20), BOARD, SIZE)
    deviations = np.array(about["standard_deviations"][:4])
    assert np.all(np.abs(found_parameters(camera) - TRUE) < 4 * deviations)
    assert np.all(deviations < 2.0)
    # Two coordinates of 0.05 px each, less the degrees of freedom taken by the fit.
    assert about["reprojection_rms_px"] == pytest.approx(0.05 * np.sqrt(2), rel=0.15)


def test_corners_gone_astray_do_not_bend_the_camera() -> None:
    corners = noisy_corners(20)
    corners[3][7] += 5.0
    corners[9][30] -= 4.0
    camera, about = calibrate(corners, BOARD, SIZE)
    assert about["outlying_corners"] == 2
    assert np.all(
        np.abs(found_parameters(camera) - TRUE) < 4 * np.array(about["standard_deviations"][:4])
    )


def test_too_few_views_are_refused() -> None:
    with pytest.raises(CalibrationDataError, match="3 views show the board; at least 5"):
        calibrate(noisy_corners(3), BOARD, SIZE)


def test_views_without_tilt_do_not_determine_a_focal_length() -> None:
    generator = np.random.default_rng(5)
    corners = [
        project(placement(distance)) + generator.normal(0, 0.05, (35, 2))
        for distance in np.linspace(0.5, 0.8, 6)
    ]
    with pytest.raises(CalibrationDataError, match="tilt the board about both axes"):
        calibrate(corners, BOARD, SIZE)


def test_the_warning_turns_focal_length_into_slope() -> None:
    camera, about = calibrate(noisy_corners(20), BOARD, SIZE)
    slope = 1e3 * about["standard_deviations"][0] / camera.matrix[0][0]
    assert f"{slope:.1f} mm/m" in calibration_warning(camera, about)
