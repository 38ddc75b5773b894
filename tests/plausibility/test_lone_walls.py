"""A wall at an unknown place that no other frame shows says nothing of the camera."""

from dataclasses import replace

import diagnosed_recordings
import numpy as np
import pytest

import tofcorr
from tofcorr.data.recording import Recording
from tofcorr.plausibility.examine import inspect

NO_EFFECT = {"shots": [{"target": "white", "poses": 12}]}


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Recording:
    return diagnosed_recordings.recorded(
        tmp_path_factory.mktemp("lone_walls") / "recording", 71, changes=NO_EFFECT
    )


def _with_planes(recording: Recording, moved: np.ndarray) -> Recording:
    """Return the recording with estimated planes, each moved by so much, metres."""
    rows = replace(recording.frames, offset=recording.frames.offset + moved)
    return replace(recording, frames=rows, planes="estimated")


def test_a_plane_for_each_frame_cannot_be_estimated_and_is_refused_in_a_sentence(
    recording: Recording,
) -> None:
    """`train` ended in a traceback, and `evaluate` told of errors of 0.00 mm."""
    own = _with_planes(recording, 1e-3 * np.arange(recording.num_frames))
    for command in (tofcorr.train, tofcorr.evaluate):
        with pytest.raises(tofcorr.CalibrationDataError, match="12 of 12 frames have a plane") as e:
            command(own)
        assert "give all frames of one wall the same nx, ny, nz, d" in str(e.value)


def test_a_few_frames_of_another_wall_do_no_harm(recording: Recording) -> None:
    moved = np.zeros(recording.num_frames)
    moved[3] = 0.01
    found = inspect(_with_planes(recording, moved))
    assert not found.impossible
