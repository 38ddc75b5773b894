"""The intervals hold the truth as often as they say."""

import pytest
from simulated_walls import EA, QUIET, SENSOR, wall_options

from benchmarks.coverage import study
from tofcorr.training.calibration import TrainingOptions


@pytest.mark.slow
def test_95_percent_intervals_of_the_hand_eye_hold_the_truth_about_as_often() -> None:
    result = study(
        wall_options(0, sensor=SENSOR | QUIET), TrainingOptions(name="EA", model=EA), 60, 1
    )
    coverage = result["coverage"]
    assert isinstance(coverage, dict)
    # 60 recordings of three axes each: the standard error of a coverage of 0.95 is 0.03 if the
    # axes of one recording go together.
    assert coverage["translation"] == pytest.approx(0.95, abs=0.07)
    assert coverage["rotation"] == pytest.approx(0.95, abs=0.07)
