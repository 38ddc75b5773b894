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
from tofcorr.training.report import hand_eye_errors
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


def judged(trained: Trained, fit: Fit, noise: float | None = None, **rms: float) -> tuple[str, str]:
    """Judge a fit; with another noise of a pixel and other errors, millimetres, if given."""
    train, hand_eye = trained.result.calibration.train, fit.solution.parameters.tool_from_camera
    support, errors = Support(trained.data, train, hand_eye), trained.report()["error_mm"]
    inspection = tofcorr.inspect(trained.recording)
    if noise is not None:
        look = inspection.look
        look.noise = look.noise_rms = noise / 1e3
        look.scene.off_by[:] = noise / 1e3
        errors = {k: {half: {"rms": rms[k]} for half in errors[k]} for k in rms}
    return judge(fit, errors, support, inspection)[:2]


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


def scattered(fit: Fit, error: float) -> Fit:
    """Return a fit whose t_z has another standard error, metres, beside its own."""
    matrix = fit.covariance.matrix.clone()
    matrix[2, 2] += error**2
    return replace(fit, covariance=replace(fit.covariance, matrix=matrix))


def test_every_standard_error_is_of_one_matrix(trained: Trained) -> None:
    """A run with 11 mm said that all was determined; a table t_z ± 39 mm, its sentence 18 mm."""
    fit = trained.result.fit
    assert judged(trained, fit)[0] == "good"
    wide = scattered(fit, 39e-3)
    verdict, reason = judged(trained, wide)
    assert verdict == "usable"
    assert "known too roughly" in reason
    assert max(1e3 * hand_eye_errors(wide)[0]) == pytest.approx(39, rel=0.1)
    # Directions are orthonormal: their variances add up to those of the unknowns.
    variance = wide.covariance.matrix[6:, 6:].trace() + wide.hand_eye_covariance.trace()
    assert sum(one.sigma**2 for one in wide.directions) == pytest.approx(float(variance))
    told = trained.report()["observability"]["weakest"][0]["sigma_mm_or_mrad"]
    assert told == pytest.approx(1e3 * fit.directions[0].sigma)


@pytest.mark.parametrize(
    ("noise", "held_out", "expected"),
    [(7.0, 20.1, "do not use"), (20.0, 20.1, "usable"), (7.0, 9.0, "usable")],
)
def test_a_run_that_gains_nothing_is_not_to_be_used_unless_noise_explains_it(
    trained: Trained, noise: float, held_out: float, expected: str
) -> None:
    """It was `usable` with 20.1 mm, and 20.9 mm with the hand-eye alone."""
    fit = scattered(trained.result.fit, 11e-3)
    verdict, reason = judged(trained, fit, noise, after=held_out, hand_eye_only=20.9)
    assert (verdict, "nothing is gained" in reason) == (expected, expected == "do not use")
