"""Frames that the robot took standing still are one pose, with and without a `pose_id`."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from small_recordings import frame_rows, write_small_recording

from tofcorr.data.recording import Recording, pose_numbers, repeat_numbers
from tofcorr.pixels.dataset import Dataset, SplitOptions, split_frames


def _recording(folder: Path, step: float, *, named: bool = False, moves: bool = True) -> Recording:
    """Write three stops of two frames; within a stop every frame is `step` further on, metres."""
    stops = frame_rows(np.random.default_rng(3))[::2]
    rows = []
    for frame in range(6):
        stop = stops[frame // 2]
        pose = stop.world_from_tool.copy() if moves else np.eye(4)
        pose[0, 3] += step * (frame % 2)
        pose_id = frame // 2 if named else None
        rows.append(replace(stop, timestamp=float(frame), world_from_tool=pose, pose_id=pose_id))
    return Recording.open(write_small_recording(folder, rows=rows))


@pytest.mark.parametrize("named", [True, False])
def test_frames_of_one_stop_share_a_number(named: bool, tmp_path: Path) -> None:
    recording = _recording(tmp_path / "stops", 2e-5, named=named)
    assert (recording.frames.pose_id is not None) == named
    assert pose_numbers(recording).tolist() == [0, 0, 1, 1, 2, 2]


def test_what_moves_is_another_pose_and_without_a_robot_every_frame(tmp_path: Path) -> None:
    assert pose_numbers(_recording(tmp_path / "moved", 1e-4)).tolist() == [0, 1, 2, 3, 4, 5]
    recording = _recording(tmp_path / "tripod", 0.0, moves=False)
    assert pose_numbers(recording).tolist() == [0, 1, 2, 3, 4, 5]


def test_a_robot_that_creeps_does_not_stand_still(tmp_path: Path) -> None:
    # Every frame is 40 micrometres from the one before: they were one pose, however many.
    row, step = frame_rows(np.random.default_rng(3))[0], 4e-5 * np.eye(4, k=3)
    poses = [row.world_from_tool + frame * step for frame in range(6)]
    rows = [replace(row, world_from_tool=pose, pose_id=None) for pose in poses]
    recording = Recording.open(write_small_recording(tmp_path / "creeping", rows=rows))
    assert pose_numbers(recording).tolist() == [0, 0, 1, 1, 2, 2]


def test_frames_of_another_exposure_or_target_are_no_repeats(tmp_path: Path) -> None:
    """Their errors differ too: the noise of a pixel was 6 and 10 mm where 4 is true."""
    row = replace(frame_rows(np.random.default_rng(3))[0], pose_id="one", target="white")
    times, targets = (1e-3, 5e-4, 1e-3, 1e-3, 5e-4, 1e-3), ("white",) * 5 + ("board",)
    given = zip(times, targets, strict=True)
    rows = [replace(row, integration_time=time, target=target) for time, target in given]
    recording = Recording.open(write_small_recording(tmp_path / "one", rows=rows))
    assert pose_numbers(recording).tolist() == [0] * 6
    assert repeat_numbers(recording).tolist() == [0, 1, 0, 0, 1, 2]


def test_no_stop_is_fitted_and_held_out_at_once(tmp_path: Path) -> None:
    # Without a pose_id the repeats of one pose were in both halves.
    data = Dataset((_recording(tmp_path / "stops", 0.0),))
    train, test = split_frames(data, SplitOptions(test_fraction=0.34))
    assert {int(k) // 2 for k in train}.isdisjoint(int(k) // 2 for k in test)
    assert len(train) + len(test) == 6
