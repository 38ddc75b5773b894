"""A gap that no camera makes is refused in place of being given a cause."""

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from benchmarks.wrong_recordings.parts import Parts
from tofcorr.data.recording import Recording
from tofcorr.diagnosis.diagnose import prepare
from tofcorr.diagnosis.findings import outliers
from tofcorr.diagnosis.findings.outliers import LARGEST_GAP, refuse_impossible_gap
from tofcorr.diagnosis.options import DiagnosisOptions
from tofcorr.errors import CalibrationDataError
from tofcorr.pixels.dataset import Dataset
from tofcorr.plausibility.examine import examine


def scattered(clean: Recording, folder: Path, metres: float) -> Recording:
    """Move every pose towards the wall or away from it, at random."""
    parts = Parts.read(clean.path)
    signs = np.random.default_rng(5).choice([-1.0, 1.0], len(parts.poses))
    poses = parts.poses.copy()
    poses[:, :3, 3] += metres * signs[:, None] * parts.normal
    return Recording.open(parts.changed(poses=poses).write(folder))


@pytest.mark.parametrize(
    ("scatter", "stops"),
    [pytest.param(0.5 * LARGEST_GAP, False, marks=pytest.mark.slow), (0.8, True)],
)
def test_a_gap_above_200_mm_ends_with_what_is_odd_in_place_of_a_cause(
    nothing_missing: Recording, tmp_path: Path, scatter: float, stops: bool
) -> None:
    recording = scattered(nothing_missing, tmp_path / "scattered", scatter)
    study = prepare(recording, DiagnosisOptions(most_pixels=6_000), None).study
    odd = examine(Dataset((recording,)))
    if not stops:
        refuse_impossible_gap(study, odd)
        return
    with pytest.raises(CalibrationDataError) as refusal:
        refuse_impossible_gap(study, odd)
    assert "no effect of a camera makes more than 200 mm" in str(refusal.value)
    assert odd.findings[0].sentence in str(refusal.value)


@pytest.mark.parametrize(
    ("missed", "outlying", "words"),
    [
        (0.3, (), ["disagree by 300 mm"]),
        (612.8, (5, 11), ["by more than a metre", "Leave frames 5 and 11 out"]),
    ],
)
def test_a_fit_that_diverged_has_no_size_and_single_wrong_frames_are_to_be_left_out(
    missed: float, outlying: tuple[int, ...], words: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Four frames with the plane of another wall were off by 612802 mm, with no remedy."""
    monkeypatch.setattr(outliers, "missed_distance", lambda _: missed)
    odd: Any = SimpleNamespace(findings=(), outlying=outlying)
    recording = SimpleNamespace(path="wall")
    study: Any = SimpleNamespace(observations=SimpleNamespace(recording=recording))
    with pytest.raises(CalibrationDataError) as refusal:
        refuse_impossible_gap(study, odd)
    assert all(word in str(refusal.value) for word in words)
