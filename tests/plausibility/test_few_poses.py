"""A camera that was knocked is found with few poses too, and what cannot be seen is said."""

from dataclasses import replace

import diagnosed_recordings
import numpy as np
import pytest

from tofcorr.data.recording import Recording
from tofcorr.pixels.dataset import Dataset
from tofcorr.plausibility.examine import examine
from tofcorr.plausibility.finding import Finding


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Recording:
    folder = tmp_path_factory.mktemp("few") / "recording"
    changes = {"shots": [{"target": "checkerboard", "poses": 19}]}
    return diagnosed_recordings.recorded(folder, 73, changes=changes)


def _of_remounting(recording: Recording, poses: int, *, knocked: bool) -> list[Finding]:
    """Return what is said of the first poses; the camera turns by a degree half-way."""
    rows = recording.frames.select(np.arange(poses))
    poses_of = np.array(rows.world_from_tool)
    if knocked:
        angle = np.radians(1.0)
        turn = np.eye(4)
        turn[1:3, 1:3] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
        turn[:3, 3] = [0.004, -0.003, 0.006]
        poses_of[poses // 2 :] = poses_of[poses // 2 :] @ turn
    images = {"depth": recording.depth[:poses], "amplitude": np.array(recording.amplitude)[:poses]}
    fewer = replace(recording, frames=replace(rows, world_from_tool=poses_of), **images)
    return [one for one in examine(Dataset((fewer,))).findings if one.check == "remounting"]


def test_a_camera_that_moved_is_found_with_sixteen_poses(recording: Recording) -> None:
    """It was looked for from twenty on, and a hand-eye transform 24 mm off was `usable`."""
    (found,) = _of_remounting(recording, 16, knocked=True)
    assert found.severity == "doubtful"
    assert "as if the camera had moved on the tool" in found.sentence


@pytest.mark.parametrize(
    ("poses", "words"),
    [
        (10, "10 distinct poses are too few to see whether the camera moved on the tool"),
        (19, "19 distinct poses are too few to see whether some poses are of another frame"),
    ],
)
def test_what_few_poses_cannot_show_is_said(recording: Recording, poses: int, words: str) -> None:
    (found,) = _of_remounting(recording, poses, knocked=False)
    assert found.severity == "note"
    assert found.sentence.startswith(words)
