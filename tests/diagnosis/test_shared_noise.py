"""Noise that neighbouring pixels share is noise, not a gap."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from diagnosed_recordings import STILL, altered, recorded
from optional import present
from scipy.ndimage import uniform_filter

from tofcorr.data.recording import repeats_of
from tofcorr.diagnosis.diagnose import prepare
from tofcorr.diagnosis.findings.structure import coherence
from tofcorr.diagnosis.options import DiagnosisOptions
from tofcorr.diagnosis.sums import shared_noise
from tofcorr.diagnosis.sums.observations import observe
from tofcorr.diagnosis.sums.shared_noise import Lags
from tofcorr.diagnosis.sums.study import Study

OPTIONS = DiagnosisOptions(catalogue=("wiggling",))
SIGMA = 0.002  # metres
REPEATS = {"repeat_poses": 2, "repeat_frames": 5}
REPEATED: dict[str, Any] = STILL | {"robot": STILL["robot"] | REPEATS}
both_ways = pytest.mark.parametrize("changes", [STILL, REPEATED], ids=["single", "repeats"])


def _filtered(
    folder: Path, changes: dict[str, Any], width: int, options: DiagnosisOptions = OPTIONS
) -> Study:
    """A recording whose noise, of one standard deviation, is a moving average of that width."""
    recording = recorded(folder, 48, [], changes, noise=False)
    noise = np.random.default_rng(48).normal(size=(recording.num_frames, 40, 48))
    noise = width * SIGMA * uniform_filter(noise, width, axes=(1, 2))[:, 8:32, 8:40]
    return prepare(altered(recording, lambda z: z + noise), options).study


def _shared_in_squares() -> float:
    """Mean correlation of two pixels of 3 x 3 after a moving average of 3 x 3, by hand."""
    triangle = {0: 1.0, 1: 2 / 3, 2: 1 / 3}
    cells = [(row, column) for row in range(3) for column in range(3)]
    pairs = [(a, b) for a in cells for b in cells if a != b]
    values = [triangle[abs(a[0] - b[0])] * triangle[abs(a[1] - b[1])] for a, b in pairs]
    return float(np.mean(values))


@both_ways
def test_what_a_filter_makes_neighbours_share_is_measured_and_is_no_structure(
    changes: dict[str, Any], tmp_path: Path
) -> None:
    study = _filtered(tmp_path / "filtered", changes, 3)
    shared = study.fit.shared
    assert shared.from_repeats == (changes is REPEATED)
    assert shared.share["squares"] == pytest.approx(_shared_in_squares(), rel=0.2)
    left = coherence(study, study.residual_of(()))
    assert abs(left.within) < 4 * max(study.fit.shared.error.values()) * SIGMA**2
    assert study.fit.floor == pytest.approx(SIGMA, rel=0.15)


@both_ways
def test_a_filter_is_measured_from_some_poses_of_a_long_recording(
    changes: dict[str, Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    longer = changes | {"shots": [{"target": "white", "poses": 24}]}
    frames: list[int] = []

    def noted(values: np.ndarray, used: np.ndarray) -> Lags:
        frames.append(len(values))
        return Lags(values, used)

    monkeypatch.setattr(shared_noise, "MOST_PIXELS", 24 * 32 * 20)
    monkeypatch.setattr(shared_noise, "Lags", noted)
    study = _filtered(tmp_path / "filtered", longer, 3)
    assert study.fit.shared.share["squares"] == pytest.approx(_shared_in_squares(), rel=0.2)
    assert 0 < max(frames) <= 20 < study.observations.num_frames


def test_a_wide_filter_does_not_hide_the_noise_of_single_frames(tmp_path: Path) -> None:
    """Differences over three pixels see half of the variance that a filter of five leaves."""
    study = _filtered(tmp_path / "wide", STILL, 5)
    assert study.fit.shared.level > 1.2
    assert study.fit.floor == pytest.approx(SIGMA, rel=0.15)


def test_a_filter_is_seen_where_few_pixels_of_each_image_are_chosen(tmp_path: Path) -> None:
    """Chosen pixels are far apart; their floor was that of differences between neighbours."""
    few = OPTIONS.model_copy(update={"most_pixels": 2000})
    study = _filtered(tmp_path / "wide", STILL, 5, few)
    assert study.observations.is_sample
    assert study.fit.floor == pytest.approx(SIGMA, rel=0.15)


@both_ways
def test_stripes_that_move_from_frame_to_frame_are_no_filtered_noise(
    changes: dict[str, Any], tmp_path: Path
) -> None:
    """Neighbours share them, but so do pixels farther apart than a filter reaches."""
    recording = recorded(tmp_path / "striped", 48, [], changes, noise=False)
    random = np.random.default_rng(48)
    row, column = np.mgrid[:24, :32]
    start = random.uniform(0, 2 * np.pi, (recording.num_frames, 1, 1))
    stripes = 3 * SIGMA * np.sin(0.2 * column + 0.3 * row + start)
    odd = stripes + SIGMA * random.normal(size=stripes.shape)
    study = prepare(altered(recording, lambda z: z + odd), OPTIONS).study
    assert study.fit.shared.striped
    assert study.fit.noise.repeats == 0
    assert study.fit.floor == pytest.approx(SIGMA, rel=0.25)


def test_repeats_show_a_filter_where_a_recording_is_thinned_out(tmp_path: Path) -> None:
    """Frames of a pose once kept different pixels; without a common one all noise was single."""
    few = OPTIONS.model_copy(update={"most_pixels": 7000})
    study = _filtered(tmp_path / "thin", REPEATED, 3, few)
    assert study.fit.shared.from_repeats
    assert study.fit.shared.share["squares"] > 0.1
    left = coherence(study, study.residual_of(()))
    assert abs(left.within) < 4 * max(study.fit.shared.error.values()) * SIGMA**2
    assert study.fit.floor == pytest.approx(SIGMA, rel=0.15)


def test_a_smooth_pattern_that_stands_still_is_no_filtered_noise(tmp_path: Path) -> None:
    """In units of the noise it differs from frame to frame, for far frames are noisier."""
    recording = recorded(tmp_path / "ring", 48, [], STILL)
    row, column = np.mgrid[:24, :32]
    ring = np.exp(-0.5 * ((np.hypot(row - 11.5, column - 15.5) - 8) / 2) ** 2)
    recording = altered(recording, lambda z: z + 0.02 * ring)
    study = prepare(recording, OPTIONS).study
    assert set(study.fit.shared.share.values()) == {0.0}


def test_what_no_two_frames_show_is_not_known() -> None:
    used = np.zeros((3, 24, 32), dtype=bool)
    used[0] = True
    cells = np.arange(24 * 32).reshape(24, 32) // 12
    values = np.random.default_rng(1).normal(size=used.shape)
    assert Lags(values, used).mean_in_tiles(cells, 0.0)[1] == np.inf


def test_few_pixels_are_no_stripes_by_chance() -> None:
    """Of white noise at few pixels the two halves of the frames agree in nothing far."""
    random = np.random.default_rng(2)
    found = 0
    for _ in range(40):
        used = random.uniform(size=(12, 24, 32)) < 0.05
        found += Lags(random.normal(size=used.shape), used).reaches_far(0.2)
    assert found <= 1


def test_independent_noise_shares_nothing(nothing_study: Study) -> None:
    shared = nothing_study.fit.shared
    assert set(shared.share.values()) == {0.0}
    assert shared.level == 1.0


def test_frames_of_a_pose_keep_the_same_pixels(tmp_path: Path) -> None:
    recording = recorded(tmp_path / "thin", 49, [], REPEATED)
    budget = 200
    observations = observe(recording, budget * recording.num_frames)
    of_pose: dict[int, set[int]] = {}
    for frame, unit in enumerate(observations.unit.tolist()):
        own = set(observations.pixel[observations.frame == frame].tolist())
        usable = int((observations.distance_images[frame] > 0).sum())
        assert abs(len(own) - min(budget, usable)) <= 3
        assert of_pose.setdefault(unit, own) == own


def test_repeats_have_one_exposure(tmp_path: Path) -> None:
    changes = REPEATED | {"conditions": {"integration_time_us": [250.0, 1000.0]}}
    recording = recorded(tmp_path / "exposures", 49, [], changes)
    observations = observe(recording, 10_000)
    groups = repeats_of(observations.recording)
    assert sorted(np.concatenate(groups).tolist()) == list(range(recording.num_frames))
    time = present(recording.frames.by_name()["integration_time"])
    for group in groups:
        assert len(set(np.asarray(time)[group].tolist())) == 1
        assert len(set(observations.unit[group].tolist())) == 1
    assert max(len(group) for group in groups) > 1
