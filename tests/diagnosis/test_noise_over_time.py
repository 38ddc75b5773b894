"""What repeated frames say of the noise, where a filter makes successive frames alike."""

from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import diagnosed_recordings
import numpy as np
import pytest

from tofcorr.data.recording import Recording
from tofcorr.diagnosis.findings.naming import NamedEffects
from tofcorr.diagnosis.findings.structure import noise_floor
from tofcorr.diagnosis.options import DiagnosisOptions
from tofcorr.diagnosis.prepare import prepare
from tofcorr.diagnosis.sums.noise import PixelNoise
from tofcorr.diagnosis.sums.study import Study

SIGMA = 0.002  # metres
KEPT = 0.7  # share that a frame keeps of the noise of the one before


def _recorded(folder: Path, frames: int) -> Study:
    """Twelve poses and two more with several frames each, whose noise a filter makes alike."""
    changes: dict[str, Any] = {
        "shots": [{"target": "white", "poses": 12}],
        "conditions": {"integration_time_us": [500.0]},
        "robot": {
            "repeatability_mm": 0.0,
            "repeatability_mrad": 0.0,
            "repeat_poses": 2,
            "repeat_frames": frames,
        },
    }
    recording = diagnosed_recordings.recorded(folder, 48, [], changes, noise=False)
    depth = np.load(recording.path / "depth.npy")
    noise = SIGMA * np.random.default_rng(7).standard_normal(depth.shape)
    pose = recording.frames.pose_id
    assert pose is not None
    for frame in range(1, len(depth)):
        if pose[frame] != "" and pose[frame] == pose[frame - 1]:
            noise[frame] = KEPT * noise[frame - 1] + np.sqrt(1 - KEPT**2) * noise[frame]
    np.save(recording.path / "depth.npy", (depth + noise).astype(np.float32))
    return prepare(Recording.open(recording.path), DiagnosisOptions(catalogue=("wiggling",))).study


def test_a_filter_over_time_is_seen_in_five_frames_of_a_pose(tmp_path: Path) -> None:
    study = _recorded(tmp_path / "five", 5)
    least, ratio, most = study.fit.noise.ratios
    assert least < ratio < most
    # By hand: the mean of 0.7^|i - j| over the pairs of five frames is 0.4855, so that differences
    # alone would say sqrt(1 - 0.4855) = 0.72 of it.
    assert study.fit.floor == pytest.approx(SIGMA, rel=0.05)


def test_two_frames_of_a_pose_leave_the_noise_open_and_the_residual_decides(
    tmp_path: Path,
) -> None:
    study = _recorded(tmp_path / "two", 2)
    noise = study.fit.noise
    assert noise.repeats == 4
    # Their differences alone would say sqrt(1 - 0.7) = 0.55 of it.
    assert noise.least * study.fit.floor < 0.7 * SIGMA
    assert noise.most * study.fit.floor > 0.99 * SIGMA
    floor = noise_floor(cast("NamedEffects", SimpleNamespace(study=study, columns=())))
    assert floor.size == pytest.approx(SIGMA, rel=0.05)


def test_where_repeats_say_more_than_neighbours_allow_either_may_be_right() -> None:
    one = np.ones(1)
    noise = PixelNoise(
        knots=one,
        sigma=one,
        factor=one,
        error=0.05,
        repeats=6,
        ratios=(1.2, 1.4, 1.6),
        spread=0.1,
    )
    # By hand: neighbours allow 1.3 x 1.05, and poses differ by 10 % in what repeats say.
    assert noise.limits(1.3) == pytest.approx((1.08, 1.365, 1.4))
    assert noise.limits(2.0) == pytest.approx((1.08, 1.4, 1.76))
