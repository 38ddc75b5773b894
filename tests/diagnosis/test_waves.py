"""Waves over the image: structure is told from noise without knowing how much noise there is."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.ndimage import gaussian_filter
from torch import Tensor

from tofcorr.diagnosis.findings.structure import unlike_waves
from tofcorr.diagnosis.sums.study import Study


def _with_residual(study: Study, residual: Tensor) -> Study:
    """Return the study with another residual; the model is not fitted to it."""
    weighted = study.sums.weighted.clone()
    weighted[:, -1] = weighted[:, :, -1] = 0.0
    sums = replace(study.sums, weighted=weighted)
    return replace(study, system=replace(study.system, residual=residual, sums=sums))


def _noise(study: Study, seed: int, width: float = 0.0) -> Tensor:
    """Return noise of every pixel's standard deviation, filtered in its frame, (M,)."""
    camera, observations = study.inputs.camera, study.observations
    rng = np.random.default_rng(seed)
    images = rng.standard_normal((observations.num_frames, camera.height, camera.width))
    if width:
        images = gaussian_filter(images, (0, width, width), mode="wrap")
    flat = torch.from_numpy(images).flatten(1)
    return flat[observations.frame, observations.pixel] * study.fit.sigma


@pytest.mark.parametrize("width", [0.0, 1.2])
def test_noise_has_the_same_energy_in_all_waves_filtered_or_not(
    nothing_study: Study, width: float
) -> None:
    """P-values are uniform at most: Bonferroni's correction makes them larger."""
    found = [
        unlike_waves(_with_residual(nothing_study, _noise(nothing_study, seed, width)), ()).p_value
        for seed in range(12)
    ]
    assert min(found) > 0.05 / 12
    assert np.median(found) > 0.3


def test_stripes_that_move_from_frame_to_frame_are_found_under_filtered_noise(
    nothing_study: Study,
) -> None:
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
    poses = torch.full((nothing_study.system.sums.num_units, 3), 2e-3, dtype=torch.float64)
    moved = 3 * noise + nothing_study.pose_surface(poses)
    again = unlike_waves(_with_residual(nothing_study, moved), ())
    assert again.p_value == pytest.approx(first.p_value, rel=1e-3)
    assert again.square == pytest.approx(9 * first.square, rel=1e-2)
