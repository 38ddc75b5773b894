"""What the noise of the distances does to the hand-eye transform."""

import shutil
from pathlib import Path

import numpy as np
import pytest
import torch
from diagnosed_recordings import recorded

from tofcorr.data.recording import Recording
from tofcorr.fit.fitting import fit
from tofcorr.fit.noise_shift import with_noise
from tofcorr.fit.result import Fit
from tofcorr.options import resolve_options
from tofcorr.pixels.dataset import Dataset
from tofcorr.pixels.domain import covered_domain
from tofcorr.training.hand_eye import hand_eye_accuracy
from tofcorr.training.options import TrainingOptions

SIGMA = 0.02  # metres
CHANGES = {
    "shots": [{"target": "white", "poses": 12}],
    "conditions": {"integration_time_us": [500.0]},
    "robot": {"repeatability_mm": 0.0, "repeatability_mrad": 0.0},
}


def _fitted(folder: Path) -> Fit:
    dataset = Dataset((Recording.open(folder),))
    frames = np.arange(dataset.num_frames)
    found = fit(
        dataset, frames, resolve_options(TrainingOptions, "ea"), covered_domain(dataset, frames)
    )
    return with_noise(found, dataset, frames)


@pytest.fixture(scope="module")
def fits(tmp_path_factory: pytest.TempPathFactory) -> tuple[Fit, list[Fit]]:
    """Fits to a recording without noise, and to the same with other noise each time."""
    clean = recorded(tmp_path_factory.mktemp("shift") / "clean", 61, [], CHANGES, noise=False).path
    depth, random = np.load(clean / "depth.npy"), np.random.default_rng(61)
    noisy = []
    for draw in range(6):
        folder = clean.parent / f"noisy_{draw}"
        shutil.copytree(clean, folder)
        noise = SIGMA * random.standard_normal(depth.shape)
        np.save(folder / "depth.npy", (depth + noise).astype(np.float32))
        noisy.append(_fitted(folder))
    return _fitted(clean), noisy


def test_the_noise_moves_the_hand_eye_transform_as_far_as_is_said(
    fits: tuple[Fit, list[Fit]],
) -> None:
    clean, noisy = fits
    there = clean.solution.parameters.tool_from_camera
    moved = torch.stack(
        [
            there[:3, :3].T @ (one.solution.parameters.tool_from_camera - there)[:3, 3]
            for one in noisy
        ]
    )
    said = torch.stack([one.noise_shift[:3] for one in noisy if one.noise_shift is not None])
    assert len(said) == len(noisy)
    error = moved.std(0) / len(noisy) ** 0.5
    assert moved.mean(0)[2].abs() > 5 * error[2]
    assert float(moved.mean(0)[2]) == pytest.approx(float(said.mean(0)[2]), rel=0.3)


def test_standard_errors_hold_what_the_noise_moves(fits: tuple[Fit, list[Fit]]) -> None:
    one = fits[1][0]
    accuracy = hand_eye_accuracy(one)
    assert accuracy is not None
    assert one.noise_shift is not None
    said = torch.tensor(accuracy.translation_se_mm).square().sum()
    scatter = one.covariance.matrix[:3, :3].diagonal().sum()
    assert float(said) == pytest.approx(1e6 * float(scatter + one.noise_shift[:3].square().sum()))
