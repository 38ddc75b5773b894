"""Poses at the times of images, the stops among them, and the lag of a clock."""

import numpy as np
import pytest
from cameras import rigid
from importing.posed_scene import Drive, Recorded
from optional import present
from scipy.spatial.transform import Rotation

from tofcorr.errors import CalibrationDataError
from tofcorr.importing.pose_track import PoseTrack
from tofcorr.importing.timing import estimate_lag, far_lags, find_stops, pair


def screw(times: np.ndarray) -> PoseTrack:
    """A tool that moves at 0.2 m/s along x and turns at 0.5 rad/s about z."""
    turns = Rotation.from_rotvec(0.5 * times[:, None] * [0, 0, 1.0])
    return PoseTrack.checked(rigid(turns, 0.2 * times[:, None] * [1.0, 0, 0]), "screw", times)


def test_motion_is_interpolated_up_to_a_gap_which_is_named() -> None:
    track = screw(np.arange(0.0, 2.05, 0.1))
    times = np.array([0.033, 0.15, 1.987])
    np.testing.assert_allclose(track.at(times), screw(times).world_from_tool, atol=1e-12)
    assert np.isnan(track.at(np.array([-0.01, 2.01]))).all()
    track = screw(np.array([0.0, 0.1, 0.2, 0.3, 1.3, 1.4, 1.5, 1.6]))
    times = np.array([0.15, 0.8, 9.0])
    images, _, refused, _ = pair(["a", "b", "c"], times, track, tolerance=0.2)
    assert list(images) == [0]
    assert "0.500 s away" in refused["b"]
    assert "after the last" in refused["c"]


def test_images_are_paired_with_the_nearest_pose_or_by_name() -> None:
    track = screw(np.array([0.0, 3.0, 6.0]))
    _, found, refused, _ = pair(["a", "b", "c"], np.array([0.1, 2.9, 4.5]), track, tolerance=0.2)
    np.testing.assert_array_equal(found, track.world_from_tool[:2])
    assert list(refused) == ["c"]
    poses = screw(np.arange(3.0)).world_from_tool
    track = PoseTrack.checked(poses, "list", names=["c.png", "a.png", "x.png"])
    images, found, _, _ = pair(["a", "b", "c"], None, track, tolerance=0.2)
    assert list(images) == [0, 2]
    np.testing.assert_array_equal(found, poses[[1, 0]])
    with pytest.raises(CalibrationDataError, match="3 poses and 2 images"):
        pair(["a", "b"], None, PoseTrack.checked(poses, "list"), tolerance=0.2)


def followed(recorded: Recorded) -> tuple[PoseTrack, np.ndarray]:
    """Return the poses of a drive, and how much each image differs from the one before, metres."""
    track = PoseTrack.checked(recorded.world_from_tool, "drive", recorded.pose_times)
    depth = recorded.depth_mm.astype(float).reshape(len(recorded.depth_mm), -1) / 1e3
    return track, np.median(np.abs(np.diff(depth, axis=0)), axis=1)


def test_stops_are_those_of_the_programme() -> None:
    drive = Drive(stops=8, width=4, height=4, rate=20.0)
    recorded = drive.record()
    track, _ = followed(recorded)
    found = find_stops(track, recorded.image_times, margin=0.02)
    assert found.max() == 7
    # An image beside a stop's end may be told to move: its poses are interpolated over 0.1 s.
    still = found >= 0
    assert not (still & (recorded.stop < 0)).any()
    assert (still & (recorded.stop >= 0)).sum() > 0.75 * (recorded.stop >= 0).sum()
    np.testing.assert_array_equal(found[still], recorded.stop[still])


@pytest.mark.parametrize("late", [-0.4, 0.0, 0.08])
def test_the_lag_follows_from_what_changes_when(late: float) -> None:
    recorded = Drive(stops=12, width=8, height=8, rate=15.0).record()
    track, change = followed(recorded)
    lag = present(estimate_lag(track, recorded.image_times + late, change))
    # The first estimate is refined once the walls are known; a frame lasts 67 ms.
    assert abs(lag.seconds - late) < 0.035


@pytest.mark.parametrize("late", [pytest.param(3.0, marks=pytest.mark.slow), -4.6])
def test_lags_of_seconds_are_proposed_among_those_of_stops_at_equal_times(late: float) -> None:
    recorded = Drive(stops=20, width=8, height=8).record()
    track, change = followed(recorded)
    proposed = np.array(far_lags(track, recorded.image_times + late, change))
    assert len(proposed) <= 12
    assert np.abs(proposed - late).min() < 0.15


def test_images_without_any_change_tell_no_lag() -> None:
    recorded = Drive(stops=12, width=8, height=8).record()
    track, _ = followed(recorded)
    noise = np.random.default_rng(0).uniform(size=len(recorded.image_times) - 1)
    assert estimate_lag(track, recorded.image_times, noise) is None
