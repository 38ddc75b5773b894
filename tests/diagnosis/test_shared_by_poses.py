"""Structure that poses share at one place or brightness is no noise, whatever neighbours share."""

from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest
import torch
from diagnosed_recordings import recorded
from scipy.ndimage import uniform_filter
from torch import Tensor

from tofcorr.data.recording import Recording
from tofcorr.diagnosis.findings.naming import NamedEffects
from tofcorr.diagnosis.findings.structure import noise_floor, shared_by_poses
from tofcorr.diagnosis.options import DiagnosisOptions
from tofcorr.diagnosis.prepare import prepare
from tofcorr.diagnosis.sums.study import Study

SIGMA = 0.002  # metres
SIZE = 0.001  # metres, root mean square


def _noise(study: Study) -> Tensor:
    """Noise that neighbours share within a frame, shape (M,)."""
    camera, observations = study.inputs.camera, study.observations
    random = np.random.default_rng(5)
    white = random.standard_normal((observations.num_frames, camera.height, camera.width))
    images = 3 * SIGMA * torch.from_numpy(np.stack([uniform_filter(one, 3) for one in white]))
    return images.reshape(len(images), -1)[observations.frame, observations.pixel]


def _bumps(study: Study) -> Tensor:
    across = study.inputs.target_xy @ torch.tensor([20.0, 9.0], dtype=torch.float64)
    return SIZE * 2**0.5 * torch.sin(across)


def _of_amplitude(study: Study) -> Tensor:
    return SIZE * 2**0.5 * torch.sin(4 * study.inputs.known_amplitude.log())


@pytest.mark.parametrize("error", [_bumps, _of_amplitude])
def test_what_poses_share_is_measured_beneath_noise_that_neighbours_share(
    nothing_study: Study, error: Callable[[Study], Tensor]
) -> None:
    found = shared_by_poses(nothing_study, _noise(nothing_study) + error(nothing_study))
    share = nothing_study.fit.share
    true = float((share * error(nothing_study) ** 2).sum() / share.sum())
    assert found.square == pytest.approx(true, rel=0.15)
    assert abs(found.square - true) < 4 * found.error


def test_noise_alone_is_shared_by_no_poses(nothing_study: Study) -> None:
    assert shared_by_poses(nothing_study, _noise(nothing_study)).square == 0


def test_a_bent_target_is_no_filter_of_the_noise_once_it_is_known(tmp_path: Path) -> None:
    """Neighbours share what the target does: the noise would seem half as large again."""
    changes = {
        "shots": [{"target": "white", "poses": 12}],
        "conditions": {"integration_time_us": [500.0]},
        "robot": {"repeatability_mm": 0.0, "repeatability_mrad": 0.0},
    }
    bent = {"name": "target_shape", "x2_y0": 0.02, "x1_y1": 0.02, "x3_y0": 0.015}
    recording = recorded(tmp_path / "bent", 48, [bent], changes, noise=False)
    depth = np.load(recording.path / "depth.npy")
    white = np.random.default_rng(48).standard_normal(depth.shape)
    noise = 5 * SIGMA * np.stack([uniform_filter(one, 5) for one in white])
    np.save(recording.path / "depth.npy", (depth + noise).astype(np.float32))
    options = DiagnosisOptions(catalogue=("target_shape",))
    study = prepare(Recording.open(recording.path), options).study
    assert _floor(study, ()) > 1.3 * SIGMA
    assert _floor(study, ("target_shape",)) == pytest.approx(SIGMA, rel=0.1)


def test_structure_that_waves_and_poses_both_show_is_taken_off_the_noise_once(
    tmp_path: Path,
) -> None:
    """Quadrants of the image that are off by 4 mm in all images are waves, and poses share them."""
    recording = recorded(tmp_path / "quadrants", 61, noise=False)
    depth = np.load(recording.path / "depth.npy")
    height, width = depth.shape[1:]
    noise = SIGMA * np.random.default_rng(61).standard_normal(depth.shape)
    sides = [np.sign(np.arange(size) - (size - 1) / 2) for size in (height, width)]
    depth += noise + 2 * SIGMA * np.outer(*sides)
    np.save(recording.path / "depth.npy", depth)
    study = prepare(Recording.open(recording.path), DiagnosisOptions()).study
    assert _floor(study, ()) == pytest.approx(SIGMA, rel=0.05)


def _floor(study: Study, columns: tuple[str, ...]) -> float:
    return noise_floor(cast("NamedEffects", SimpleNamespace(study=study, columns=columns))).size
