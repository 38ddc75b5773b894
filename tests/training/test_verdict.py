"""What the verdict of a run says of errors that the model does not describe."""

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from simulated_walls import QUIET, simulated_wall, true_hand_eye
from training.trained import CONFIG, Trained

import tofcorr
from tofcorr.estimation.solvers import Stopped
from tofcorr.fit.problem import Fit
from tofcorr.training.judgement import beyond_noise, judge
from tofcorr.training.support import Support


@pytest.mark.parametrize(
    ("held_out", "noise", "words"),
    [
        (5.0, 3.0, "4.0 mm beyond the noise"),
        (5.0, 4.5, None),  # 2.2 mm, half of the noise
        (1.6, 0.8, None),  # 1.4 mm
        (3.0, 3.5, None),
        (None, 3.0, None),
        (5.0, math.nan, None),
    ],
)
def test_an_error_beyond_the_noise_is_named_where_it_is_large(
    held_out: float | None, noise: float, words: str | None
) -> None:
    """A wedge before the lens moved the hand-eye by 14 mm; the run was `good` and said 3.7."""
    found = beyond_noise(held_out, noise)
    assert (found is None) == (words is None)
    assert words is None or words in str(found)


def test_an_error_that_the_model_lacks_is_no_good_run(tmp_path: Path) -> None:
    """A focal length 2 % off moved the hand-eye by 20 mm; the run was `good` and said 3 mm."""
    lens = {"name": "lens", "focal_x": 0.02, "focal_y": 0.02}
    shots = (("white", 12), ("checkerboard", 16))
    data = simulated_wall(tmp_path / "wall", 11, shots, QUIET, effects=[lens])
    report = tofcorr.train(data.first.path, CONFIG | {"advice": 0}).report
    assert report["verdict"] == "usable"
    assert report["misfit"]["probe"] == "focal_length"
    assert report["reason"] in report["warnings"]
    assert "tofcorr diagnose" in report["reason"]
    off = np.subtract(report["hand_eye"]["tool_from_camera"], true_hand_eye(data).numpy())[:3, 3]
    assert (np.abs(1e3 * off) <= report["hand_eye"]["translation_ci95_mm"]).all()


def judged(trained: Trained, fit: Fit) -> tuple[str, str]:
    train, hand_eye = trained.result.calibration.train, fit.solution.parameters.tool_from_camera
    support, found = Support(trained.data, train, hand_eye), trained.report()
    inspection = tofcorr.inspect(trained.recording)
    return judge(fit, found["error_mm"], support, inspection)[:2]


@pytest.mark.parametrize(
    ("stopped", "expected"), [("not_finite", "do not use"), ("iteration_limit", "usable")]
)
def test_a_fit_that_was_rolled_back_from_nan_is_not_to_be_used(
    trained: Trained, stopped: Stopped, expected: str
) -> None:
    """It was `usable`, as one that was merely not finished."""
    fit = trained.result.fit
    ended = replace(fit, solution=replace(fit.solution, stopped=stopped))
    assert judged(trained, ended)[0] == expected


def test_a_good_run_knows_the_hand_eye_by_its_own_standard_errors(trained: Trained) -> None:
    """A run whose poses scattered, with a standard error of 11 mm, said that it was determined."""
    fit = trained.result.fit
    assert judged(trained, fit)[0] == "good"
    matrix = fit.covariance.matrix.clone()
    matrix[2, 2] += 11e-3**2
    scattered = replace(fit, covariance=replace(fit.covariance, matrix=matrix))
    verdict, reason = judged(trained, scattered)
    assert verdict == "usable"
    assert "known to 11." in reason
