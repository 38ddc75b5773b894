"""A pose that alone shows a range of distances makes the gap large, and the report says so."""

import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from diagnosed_recordings import recorded
from optional import present

from tofcorr.data.recording import Recording
from tofcorr.data.writing import RecordingWriter
from tofcorr.diagnosis.diagnose import diagnose, prepare
from tofcorr.diagnosis.findings.naming import name_effects
from tofcorr.diagnosis.next.advice import make_candidates
from tofcorr.diagnosis.options import DiagnosisOptions
from tofcorr.diagnosis.report.words import lone_poses

# An error that the polynomials of the base model follow over some range, and miss beyond it.
WIGGLING = {"name": "wiggling", "sin_4": 0.01}
OPTIONS = DiagnosisOptions(bootstraps=40, simulate_anew=False, page=False)


def _changes(distance_m: tuple[float, float], poses: int) -> dict[str, Any]:
    return {
        "robot": {"distance_m": list(distance_m), "farthest_pixel_m": 6.0},
        "shots": [{"target": "white", "poses": poses}],
    }


@pytest.fixture(scope="module")
def far(tmp_path_factory: pytest.TempPathFactory) -> Recording:
    folder = tmp_path_factory.mktemp("far") / "recording"
    return recorded(folder, 34, [WIGGLING], _changes((2.5, 4.0), 24))


def _with_one_more(far: Recording, near: Recording, folder: Path) -> Recording:
    """Append a recording's frames to another's, as if taken some hours later."""
    with RecordingWriter.like(folder, far, rows=False) as writer:
        for recording, later in ((far, 0.0), (near, 1e4)):
            for frame, row in enumerate(recording.frames.rows()):
                own = {"timestamp": row.timestamp + later, "pose_id": f"{later} {frame}"}
                images = {"amplitude": present(recording.amplitude)[frame]}
                writer.append(recording.depth[frame], row=replace(row, **own), **images)
    return Recording.open(folder)


def test_poses_that_others_are_like_are_not_alone(far: Recording) -> None:
    study = prepare(far, OPTIONS).study
    assert lone_poses(study, study.fit.floor) == ""


def test_the_one_near_pose_is_named(far: Recording, tmp_path: Path) -> None:
    near = recorded(tmp_path / "near", 35, [WIGGLING], _changes((0.5, 0.55), 1))
    joined = _with_one_more(far, near, tmp_path / "joined")
    result = diagnose(joined, config=OPTIONS)
    start = f"1 of {result.evidence.study.sums.num_units} poses, with frame {far.num_frames} and at"
    (words,) = [one for one in result.remarks if one.startswith(start)]
    pattern = r"at ([0-9.]+) to ([0-9.]+) m, hold (\d+) % .* The others make ([0-9.]+) mm"
    found = present(re.search(pattern, words))
    near, distant, share, others = map(float, found.groups())
    assert 0.4 < near <= distant < 1.0
    assert share > 90
    assert others < 1e3 * result.gap.before / 3


def test_a_last_pose_without_a_pixel_is_one_without_a_say(time_missing: Recording) -> None:
    # Its sums were left out, and the folds were of one pose more.
    depth = np.array(time_missing.depth)
    depth[-1] = np.nan
    study = prepare(replace(time_missing, depth=depth), DiagnosisOptions(bootstraps=20), None).study
    assert study.sums.num_units == study.folds.shape[1]
    assert float(study.sums.count[-1]) == 0.0
    assert name_effects(study).names == ("integration_time",)
    # What was asked next of its distance ended in a traceback.
    candidates = present(make_candidates(study, ["integration_time"]))
    assert max(candidates[1]) == len(depth) - 2
