"""The base model in the forward form."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from diagnosed_recordings import altered, recorded, simulator

from tofcorr.data.recording import Recording
from tofcorr.diagnosis.diagnose import prepare
from tofcorr.diagnosis.options import DiagnosisOptions
from tofcorr.diagnosis.sums.base import BaseFit, BaseModel, fit_base
from tofcorr.diagnosis.sums.noise import robust_weights
from tofcorr.diagnosis.sums.observations import hand_eye_columns, observe, predicted_distance
from tofcorr.diagnosis.sums.study import Study
from tofcorr.geometry import se3


def fitted(recording: Recording) -> BaseFit:
    """Fit the default base model with a free hand-eye transform."""
    observations = observe(recording, 50_000)
    model = BaseModel(observations, DiagnosisOptions().base, hand_eye_free=True)
    return fit_base(model, observations)


def test_the_hand_eye_transform_is_found_from_a_guess_far_off(nothing_missing: Recording) -> None:
    truth = simulator(31).hand_eye.tool_from_camera()
    fit = fitted(replace(nothing_missing, tool_from_camera=np.eye(4)))
    # Robot noise of 0.3 mm and 0.3 mrad over 50 poses; the offset along the axis is the weak one.
    assert float((fit.tool_from_camera - truth)[:3, 3].norm()) < 2e-3
    assert float(se3.rotation_angle(fit.tool_from_camera[:3, :3].T @ truth[:3, :3])) < 2e-3


def test_hand_eye_columns_are_the_derivative_of_the_distance(nothing_study: Study) -> None:
    observations, pose = nothing_study.observations, nothing_study.fit.tool_from_camera
    columns = hand_eye_columns(observations, pose)[1]
    for axis in range(6):
        twist = torch.zeros(6, dtype=torch.float64)
        twist[axis] = 1e-6
        ahead = predicted_distance(observations, pose @ se3.exp(twist))
        behind = predicted_distance(observations, pose @ se3.exp(-twist))
        torch.testing.assert_close((ahead - behind) / 2e-6, columns[:, axis], atol=1e-7, rtol=1e-6)


def test_the_noise_of_a_pixel_is_known_to_five_per_cent(
    nothing_missing: Recording, nothing_study: Study
) -> None:
    """Against the truth that only a simulator knows."""
    observations, fit = nothing_study.observations, nothing_study.fit
    truth = np.load(nothing_missing.path / "truth" / "radial_distance.npy")
    exact = torch.from_numpy(truth).flatten(1)[observations.frame, observations.pixel]
    error = observations.measured - exact.double()
    columns = fit.model.error_columns(nothing_study.inputs.radial_distance) / fit.sigma[:, None]
    scaled = error / fit.sigma
    left = scaled - columns @ torch.linalg.lstsq(columns, scaled[:, None]).solution[:, 0]
    assert float(left.square().mean().sqrt()) == pytest.approx(1.0, abs=0.05)


def test_a_fixed_pattern_does_not_count_as_noise(folder: Path, nothing_study: Study) -> None:
    pattern = {"name": "fixed_pattern", "rms_m": 0.006, "height": 24, "width": 32}
    fit = fitted(recorded(folder / "pattern_floor", 31, [pattern]))
    assert fit.floor == pytest.approx(nothing_study.fit.floor, rel=0.1)


def test_repeats_measure_the_floor(folder: Path, nothing_study: Study) -> None:
    repeats = {"robot": {"repeat_poses": 2, "repeat_frames": 10}}
    fit = fitted(recorded(folder / "repeats", 31, [], repeats))
    assert fit.noise.repeats == 20
    assert fit.model.observations.num_units == 50
    assert fit.floor == pytest.approx(nothing_study.fit.floor, rel=0.15)


def test_ordinary_residuals_keep_their_weight_and_gross_ones_lose_it() -> None:
    residual = torch.tensor([0.001, -0.001, 0.0005, -0.0008, 0.0011, -0.0003, 0.05, 3.7])
    weights = robust_weights(residual.double(), torch.full((8,), 0.001, dtype=torch.float64))
    assert weights[:6].tolist() == [1.0] * 6
    assert weights[6:].tolist() == [0.0, 0.0]


def test_undetermined_directions_of_the_hand_eye_stay_near_the_guess(tmp_path: Path) -> None:
    """Without tilts the poses do not determine roll, and a leaning wall would bias it."""
    lean = {"name": "target_registration", "lean_x": 0.01, "lean_y": -0.01}
    upright = {"robot": {"tilt_axes": "none"}}
    recording = recorded(tmp_path / "upright", 44, [lean], upright)
    found = fitted(recording).tool_from_camera
    away = se3.log(se3.inverse(torch.from_numpy(recording.tool_from_camera)) @ found)
    assert float(away[:3].norm()) < 0.1
    assert float(away[3:].norm()) < 0.2


@pytest.mark.parametrize(("noise", "step"), [(False, 0.0), (True, 0.02)])
def test_depth_without_noise_or_coarsely_rounded_can_be_diagnosed(
    noise: bool, step: float, tmp_path: Path
) -> None:
    """Repeats of such frames are equal: their standard deviation is zero, or nearly."""
    repeats = {"robot": {"repeat_poses": 2, "repeat_frames": 5}}
    recording = recorded(tmp_path / "odd", 31, [], repeats, noise=noise)
    if step:
        recording = altered(recording, lambda z: np.round(z / step) * step)
    few = DiagnosisOptions(catalogue=("wiggling", "saturation", "fixed_pattern"))
    study = prepare(recording, few).study
    assert bool(study.fit.sigma.isfinite().all())
    assert bool(study.sums.ols.gram.isfinite().all())
    # Rounding to a step is an error of step / sqrt(12) at most on the average.
    assert study.fit.floor < 0.01
