"""What is noise and what is structure: waves, what poses share, and what repeated frames say."""

import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest
import torch
from diagnosed_recordings import STILL, altered, recorded
from optional import present
from scipy.ndimage import gaussian_filter, uniform_filter
from torch import Tensor

from tofcorr.diagnosis.diagnose import prepare
from tofcorr.diagnosis.findings.naming import NamedEffects
from tofcorr.diagnosis.findings.structure import noise_floor, shared_by_poses, unlike_waves
from tofcorr.diagnosis.options import DiagnosisOptions
from tofcorr.diagnosis.sums.noise import PixelNoise
from tofcorr.diagnosis.sums.study import Study

SIGMA = 0.002  # metres
SIZE = 0.001  # metres, root mean square
KEPT = 0.7  # share that a frame keeps of the noise of the one before


def _floor(study: Study, *columns: str) -> float:
    return noise_floor(cast("NamedEffects", SimpleNamespace(study=study, columns=columns))).size


def _with_residual(study: Study, residual: Tensor) -> Study:
    """Return the study with another residual; the model is not fitted to it."""
    weighted = study.sums.weighted.clone()
    weighted[:, -1] = weighted[:, :, -1] = 0.0
    sums = replace(study.sums, weighted=weighted)
    return replace(study, residual=residual, sums=sums)


def _noise(study: Study, seed: int, width: float = 0.0) -> Tensor:
    """Return noise of every pixel's standard deviation, filtered in its frame, (M,)."""
    camera, observations = study.inputs.camera, study.observations
    rng = np.random.default_rng(seed)
    images = rng.standard_normal((observations.num_frames, camera.height, camera.width))
    images = gaussian_filter(images, (0, width, width), mode="wrap")
    flat = torch.from_numpy(images).flatten(1)
    return flat[observations.frame, observations.pixel] * study.fit.sigma


@pytest.mark.parametrize("width", [0.0, 1.2])
def test_noise_filtered_or_not_is_alike_in_all_waves(nothing_study: Study, width: float) -> None:
    """P-values are uniform at most: Bonferroni's correction makes them larger."""
    found = [
        unlike_waves(_with_residual(nothing_study, _noise(nothing_study, seed, width)), ()).p_value
        for seed in range(12)
    ]
    assert min(found) > 0.05 / 12
    assert np.median(found) > 0.3


def test_stripes_that_move_are_found_under_filtered_noise(nothing_study: Study) -> None:
    observations, inputs = nothing_study.observations, nothing_study.inputs
    phase = torch.linspace(0, 50, observations.num_frames)[observations.frame]
    size = 1e-3
    stripes = size * torch.sin(2 * math.pi * inputs.columns + phase)
    noise = _noise(nothing_study, 3, 1.2)
    found = unlike_waves(_with_residual(nothing_study, noise + stripes), ())
    assert found.p_value < 1e-6
    assert found.square == pytest.approx(size**2 / 2, rel=0.5)


def test_neither_the_noise_nor_the_poses_offsets_matter(nothing_study: Study) -> None:
    noise = _noise(nothing_study, 5)
    first = unlike_waves(_with_residual(nothing_study, noise), ())
    poses = torch.full((nothing_study.sums.num_units, 3), 2e-3, dtype=torch.float64)
    moved = 3 * noise + nothing_study.pose_surface(poses)
    again = unlike_waves(_with_residual(nothing_study, moved), ())
    assert again.p_value == pytest.approx(first.p_value, rel=1e-3)
    assert again.square == pytest.approx(9 * first.square, rel=1e-2)


def _bumps(study: Study) -> Tensor:
    across = study.inputs.target_xy @ torch.tensor([20.0, 9.0], dtype=torch.float64)
    return SIZE * 2**0.5 * torch.sin(across)


def _of_amplitude(study: Study) -> Tensor:
    return SIZE * 2**0.5 * torch.sin(4 * study.inputs.known_amplitude.log())


@pytest.mark.parametrize("error", [_bumps, _of_amplitude])
def test_what_poses_share_is_measured_beneath_noise_that_neighbours_share(
    nothing_study: Study, error: Callable[[Study], Tensor]
) -> None:
    noise = _noise(nothing_study, 5, 1.2)
    found = shared_by_poses(nothing_study, noise + error(nothing_study))
    share = nothing_study.fit.share
    true = float((share * error(nothing_study) ** 2).sum() / share.sum())
    assert found.square == pytest.approx(true, rel=0.15)
    assert abs(found.square - true) < 4 * found.error


def test_noise_alone_is_shared_by_no_poses(nothing_study: Study) -> None:
    assert shared_by_poses(nothing_study, _noise(nothing_study, 5, 1.2)).square == 0


def test_a_bent_target_is_no_filter_of_the_noise_once_it_is_known(tmp_path: Path) -> None:
    """Neighbours share what the target does: the noise would seem half as large again."""
    bent = {"name": "target_shape", "x2_y0": 0.02, "x1_y1": 0.02, "x3_y0": 0.015}
    recording = recorded(tmp_path / "bent", 48, [bent], STILL, noise=False)
    white = np.random.default_rng(48).standard_normal(recording.depth.shape)
    noise = 5 * SIGMA * np.stack([uniform_filter(one, 5) for one in white])
    options = DiagnosisOptions(catalogue=("target_shape",))
    study = prepare(altered(recording, lambda z: z + noise), options).study
    assert _floor(study) > 1.3 * SIGMA
    assert _floor(study, "target_shape") == pytest.approx(SIGMA, rel=0.1)


def test_structure_of_waves_and_of_poses_is_taken_off_the_noise_once(tmp_path: Path) -> None:
    """Quadrants of the image that are off by 4 mm in all images are waves, and poses share them."""
    recording = recorded(tmp_path / "quadrants", 61, noise=False)
    shape = recording.depth.shape
    noise = SIGMA * np.random.default_rng(61).standard_normal(shape)
    sides = [np.sign(np.arange(size) - (size - 1) / 2) for size in shape[1:]]
    odd = noise + 2 * SIGMA * np.outer(*sides)
    study = prepare(altered(recording, lambda z: z + odd), DiagnosisOptions()).study
    assert _floor(study) == pytest.approx(SIGMA, rel=0.05)


def _recorded(folder: Path, frames: int) -> Study:
    """Twelve poses and two more with several frames each, whose noise a filter makes alike."""
    repeats = STILL["robot"] | {"repeat_poses": 2, "repeat_frames": frames}
    recording = recorded(folder, 48, [], STILL | {"robot": repeats}, noise=False)
    noise = SIGMA * np.random.default_rng(7).standard_normal(recording.depth.shape)
    pose = present(recording.frames.pose_id)
    for frame in range(1, len(noise)):
        if pose[frame] != "" and pose[frame] == pose[frame - 1]:
            noise[frame] = KEPT * noise[frame - 1] + np.sqrt(1 - KEPT**2) * noise[frame]
    options = DiagnosisOptions(catalogue=("wiggling",))
    return prepare(altered(recording, lambda z: z + noise), options).study


def test_a_filter_over_time_is_seen_in_five_frames_of_a_pose(tmp_path: Path) -> None:
    study = _recorded(tmp_path / "five", 5)
    least, ratio, most = study.fit.noise.ratios
    assert least < ratio < most
    # By hand: the mean of 0.7^|i - j| over the pairs of five frames is 0.4855, so that differences
    # alone would say sqrt(1 - 0.4855) = 0.72 of it.
    assert study.fit.floor == pytest.approx(SIGMA, rel=0.05)


def test_two_frames_of_a_pose_leave_the_noise_open_and_the_residual_decides(tmp_path: Path) -> None:
    study = _recorded(tmp_path / "two", 2)
    noise = study.fit.noise
    assert noise.repeats == 4
    # Their differences alone would say sqrt(1 - 0.7) = 0.55 of it.
    least, likeliest, most = noise.limits(study.fit.shared.level)
    assert least / likeliest * study.fit.floor < 0.7 * SIGMA
    assert most / likeliest * study.fit.floor > 0.99 * SIGMA
    assert _floor(study) == pytest.approx(SIGMA, rel=0.05)


def test_where_repeats_say_more_than_neighbours_allow_either_may_be_right() -> None:
    one = np.ones(1)
    known = {"error": 0.05, "repeats": 6, "ratios": (1.2, 1.4, 1.6), "spread": 0.1}
    noise = PixelNoise(knots=one, sigma=one, factor=one, **known)
    # By hand: neighbours allow 1.3 x 1.05, and poses differ by 10 % in what repeats say.
    assert noise.limits(1.3) == pytest.approx((1.08, 1.365, 1.4))
    assert noise.limits(2.0) == pytest.approx((1.08, 1.4, 1.76))
