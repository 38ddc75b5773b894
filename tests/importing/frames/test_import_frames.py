"""Depth images and robot poses in files, of all formats, become one recording."""

from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from cameras import apart
from importing import scene_files
from importing.frames.imported import Imported, assert_equal_recordings, import_png, import_written
from importing.posed_scene import FRONT, Drive, Recorded, unit_rays
from optional import present

from tofcorr.examples import files

# How near the start of the fit is: the camera's error of 10 mm is not calibrated yet.
NEAR_MM, NEAR_DEG = 15.0, 0.5


def assert_start_is_near(imported: Imported, recorded: Recorded) -> None:
    off = apart(imported.done.tool_from_camera, recorded.tool_from_camera)
    assert (off < (NEAR_MM, NEAR_DEG)).all()


@pytest.fixture(scope="module")
def plain(drive: Recorded, tmp_path_factory: pytest.TempPathFactory) -> Imported:
    """The whole drive, imported without further options."""
    return import_png(drive, tmp_path_factory.mktemp("plain"))


def test_stops_are_used_and_others_listed_with_reasons(plain: Imported, drive: Recorded) -> None:
    assert_start_is_near(plain, drive)
    assert plain.report["stops"] == drive.stop.max() + 1
    assert plain.report["paired_by"] == "time"
    used = {frame["view"] for frame in plain.report["views"]}
    named = used | set(plain.reasons())
    stamps = [f"{time:.6f}" for time in drive.image_times]
    assert set(stamps) <= named
    moving = {stamp for stamp, stop in zip(stamps, drive.stop, strict=True) if stop < 0}
    assert not moving & used
    # At most three images of each stop; where there are more, the others are named.
    assert "its stop has 3 images already" in plain.text
    assert "the tool was moving" in plain.text


def test_planes_are_estimated_stops_share_a_pose_id_and_masks_hold_the_frame_s_own_wall(
    plain: Imported,
) -> None:
    recording = plain.done
    assert recording.planes == "estimated"
    assert (recording.frame_names.world, recording.frame_names.tool) == ("base", "tool")
    assert set(recording.frames.target) == {"wall 1", "wall 2", "floor"}
    stops = [f"stop {frame['stop']}" for frame in plain.report["views"]]
    assert list(present(recording.frames.pose_id)) == stops
    masks, images = np.array(recording.mask), [frame["view"] for frame in plain.report["views"]]
    assert masks.mean(axis=(1, 2)).min() > 0.03
    for view in set(images):
        assert masks[np.array(images) == view].sum(axis=0).max() == 1
    assert abs(plain.report["lag"]["seconds"]) < 0.005
    assert "late" not in plain.text


@pytest.mark.parametrize("late", [0.08, pytest.param(-0.15, marks=pytest.mark.slow)])
def test_a_late_image_clock_is_found_within_10_ms_and_named(
    drive: Recorded, tmp_path: Path, late: float
) -> None:
    # Three fifths of the drive: some moves are enough for a lag.
    drive = drive.take(np.arange(len(drive.stop) * 3 // 5))
    imported = import_png(drive.stamped_late(late), tmp_path)
    assert abs(imported.report["lag"]["seconds"] - late) < 0.010
    assert_start_is_near(imported, drive)
    assert ("late" if late > 0 else "early") in imported.text


@pytest.fixture(scope="module")
def before_one_wall() -> Recorded:
    """A drive before a single wall, by a camera that reads 40 mm too far."""
    recorded = Drive(planes=(FRONT,), stops=20, one_wall=True).record()
    height, width = recorded.depth_mm.shape[1:]
    far = 40 * unit_rays(recorded.matrix, width, height, recorded.distortion)[..., 2]
    depth = np.where(recorded.depth_mm > 0, recorded.depth_mm + np.round(far), 0)
    return replace(recorded, depth_mm=depth.astype(np.uint16))


@pytest.mark.parametrize("late", [pytest.param(0.0, marks=pytest.mark.slow), 0.03])
def test_of_a_constant_error_before_one_wall_and_a_late_clock_only_the_clock_is_named(
    before_one_wall: Recorded, tmp_path: Path, late: float
) -> None:
    # The constant looked like a clock that is 35 ms late.
    imported = import_png(before_one_wall.stamped_late(late), tmp_path)
    assert abs(imported.report["lag"]["seconds"] - late) < 0.005
    assert ("are stamped" in imported.text) == (late > 0)


def test_a_robot_that_stands_still_in_every_image_tells_no_lag(
    before_one_wall: Recorded, tmp_path: Path
) -> None:
    at_stops = before_one_wall.take(before_one_wall.stop >= 0)
    imported = import_png(at_stops, tmp_path)
    assert imported.done.num_frames > 0
    assert "are stamped" not in imported.text


@pytest.mark.slow
def test_moving_images_are_kept_if_asked_and_interpolated(drive: Recorded, tmp_path: Path) -> None:
    imported = import_png(drive.stamped_late(0.08), tmp_path, "--keep-moving")
    assert_start_is_near(imported, drive)
    stamps = {f"{time + 0.08:.6f}": k for k, time in enumerate(drive.image_times)}
    places = [stamps[frame["view"]] for frame in imported.report["views"]]
    assert sum(drive.stop[place] < 0 for place in places) > 0.8 * sum(drive.stop < 0)
    # At 0.5 m/s ten milliseconds are 5 mm; poses 0.1 s apart leave a few more to a straight line.
    poses = imported.done.frames.world_from_tool
    off = np.linalg.norm(poses[:, :3, 3] - drive.exact[places][:, :3, 3], axis=1)
    assert np.median(off) < 0.003
    assert off.max() < 0.04


@pytest.mark.slow
def test_a_camera_that_stands_still_has_its_poses_inverted_and_its_frames_named(
    drive: Recorded, plain: Imported, tmp_path: Path
) -> None:
    names = ("--base-frame", "base_link", "--tool-frame", "flange", "--camera-frame", "tof")
    imported = import_png(drive.with_camera_fixed(), tmp_path, "--eye-to-hand", *names)
    assert_start_is_near(imported, drive)
    recording = imported.done
    names = {"world": "flange", "tool": "base_link", "camera": "tof", "eye_to_hand": True}
    assert recording.frame_names.to_mapping() == names
    poses = plain.done.frames.world_from_tool
    np.testing.assert_allclose(recording.frames.world_from_tool, poses, atol=1e-6)


def test_all_formats_of_files_give_one_recording(at_stops: Recorded, tmp_path: Path) -> None:
    imported = {}
    for name, ending, write_poses in (
        ("png", "png", partial(files.write_tum, at_stops.image_times)),
        ("npy", "npy", scene_files.write_csv),
        ("tiff", "tiff", files.write_matrices),
        ("moveit", "npy", scene_files.write_moveit),
    ):
        folder = tmp_path / name
        scene_files.write_images(at_stops, folder, ending)
        file = folder / ("poses.yaml" if name == "moveit" else "poses")
        poses = write_poses(at_stops.exact, file)
        imported[name] = import_written(at_stops, folder, ending, poses)
    paired = {name: one.report["paired_by"] for name, one in imported.items()}
    assert paired == {"png": "time", "npy": "name", "tiff": "order", "moveit": "order"}
    for name in ("npy", "tiff", "moveit"):
        # A millimetre is the quantum of the PNG; metres in float32 hold it to a micrometre.
        assert_equal_recordings(imported["png"].done, imported[name].done, 1e-6)


def test_turned_images_and_swapped_bytes_are_undone_when_named_and_refused_when_not(
    at_stops: Recorded, from_files: Imported, tmp_path: Path
) -> None:
    for name, swap_bytes, turn, arguments in (
        ("swapped", True, 0, ("--big-endian",)),
        ("turned", False, 1, ("--rotate", "90")),
    ):
        folder = tmp_path / name
        scene_files.write_png(at_stops, folder, swap_bytes=swap_bytes, turn=turn)
        track = at_stops.pose_times, at_stops.world_from_tool
        poses = files.write_tum(*track, folder / "poses.txt")
        refused = import_written(at_stops, folder, "png", poses)
        assert f"Add {' '.join(arguments)}" in refused.refusal
        undone = import_written(at_stops, folder, "png", poses, *arguments)
        assert_equal_recordings(from_files.done, undone.done, 0.0)
