"""What a board cannot tell apart is stated in numbers that follow from geometry."""

from collections.abc import Iterable
from typing import Any

import numpy as np
import pytest
from importing.checkerboard.rendered_board import BOARD, CAMERA, placement, project

from tofcorr.importing.checkerboard.importer import degeneracy_warning, study_degeneracy
from tofcorr.importing.checkerboard.pose import BoardPose, estimate_pose

Found = dict[str, Any]


def posed_views(distances: Iterable[float]) -> list[tuple[np.ndarray, BoardPose, float]]:
    generator = np.random.default_rng(6)
    views = []
    for i, distance in enumerate(distances):
        where = placement(distance, tilt_x=20 * (-1) ** i, tilt_y=15)
        corners = project(where) + generator.normal(0, 0.05, (35, 2))
        pose = estimate_pose(corners, BOARD, CAMERA, 0.5)
        centre = float(pose.centre(BOARD)[2])
        views.append((corners, pose, 0.01 - 0.02 * centre))
    return views


@pytest.fixture(scope="module")
def degeneracy() -> Found:
    return study_degeneracy(posed_views(np.linspace(0.4, 0.9, 10)), BOARD, CAMERA, "z")


def test_larger_squares_and_other_focal_lengths_hide_in_the_slope(degeneracy: Found) -> None:
    assert degeneracy["as_given"]["slope_mm_per_m"] == pytest.approx(-20.0, abs=1e-6)
    (shorter, longer, larger), given = degeneracy["alternatives"], degeneracy["as_given"]
    assert larger["reprojection_rms_px"] == pytest.approx(given["reprojection_rms_px"], rel=1e-4)
    # z grows by 1 %, so the error e(z) becomes e(z) - 0.01 z, over a z that is 1 % longer.
    assert larger["slope_mm_per_m"] == pytest.approx((-20.0 - 10.0) / 1.01, abs=0.01)
    assert larger["mean_error_mm"] < given["mean_error_mm"]
    for other, slope in ((shorter, 0.0), (longer, -40.0)):
        assert other["reprojection_rms_px"] < 1.5 * given["reprojection_rms_px"]
        assert other["slope_mm_per_m"] == pytest.approx(slope, abs=5.0)
    text = degeneracy_warning(degeneracy)
    for alternative in (degeneracy["as_given"], *degeneracy["alternatives"]):
        assert f"{alternative['slope_mm_per_m']:+.1f}" in text
        assert f"{alternative['mean_error_mm']:+.1f}" in text


def test_views_at_one_distance_have_no_slope_to_quote() -> None:
    result = study_degeneracy(posed_views([0.5] * 4), BOARD, CAMERA, "z")
    assert result["as_given"]["slope_mm_per_m"] is None
    assert "mm/m" not in degeneracy_warning(result)
