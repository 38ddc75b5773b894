"""What is wrong with images and poses is said in one sentence, with the number that shows it."""

import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from importing import scene_files
from importing.frames.imported import Imported, import_png, import_written, run_import
from importing.posed_scene import Recorded
from scipy.spatial.transform import Rotation


def in_order(recorded: Recorded, folder: Path, poses: np.ndarray, *arguments: object) -> Imported:
    """Import images without time stamps, and poses in their order."""
    scene_files.write_numbered(recorded, folder, "npy")
    file = scene_files.write_matrices(poses, folder / "poses.txt")
    return import_written(recorded, folder, "npy", file, *arguments)


def test_right_images_and_poses_raise_no_suspicion(at_stops: Recorded, tmp_path: Path) -> None:
    imported = in_order(at_stops, tmp_path, at_stops.exact)
    assert imported.report["warnings"] == []


def reordered(poses: np.ndarray) -> np.ndarray:
    wrong, turns = poses.copy(), Rotation.from_matrix(poses[:, :3, :3]).as_quat()
    wrong[:, :3, :3] = Rotation.from_quat(np.roll(turns, 1, axis=1)).as_matrix()
    return wrong


def column_by_column(poses: np.ndarray) -> np.ndarray:
    wrong = poses.copy()
    wrong[:, :3, :3] = np.swapaxes(wrong[:, :3, :3], 1, 2)
    return wrong


def in_millimetres(poses: np.ndarray) -> np.ndarray:
    wrong = poses.copy()
    wrong[:, :3, 3] *= 1e3
    return wrong


@pytest.mark.parametrize(
    ("mistake", "said"),
    [
        (np.linalg.inv, "mm with their inverses.*--eye-to-hand"),
        # A few of the images showed a wall by chance, and were written.
        (reordered, "mm with quaternions read as w x y z: write them as x y z w"),
        # The same mistake's list as before; half of the poses are shifted in a test below.
        pytest.param(
            column_by_column,
            "mm with rotations inverted and translations as they are",
            marks=pytest.mark.slow,
        ),
        *(
            pytest.param(
                lambda poses, shift=shift: np.roll(poses, shift, axis=0),
                rf"with the poses shifted by {sign}",
                marks=pytest.mark.slow,
            )
            for shift, sign in ((1, "-1"), (-2, r"\+2"))
        ),
        (lambda poses: np.repeat(poses[:1], len(poses), axis=0), "all poses are the same"),
        (lambda poses: poses[1:], r"\d+ poses and \d+ images"),
        (in_millimetres, "Are the translations in millimetres"),
    ],
)
def test_poses_that_are_wrong_are_refused_with_both_numbers(
    at_stops: Recorded, tmp_path: Path, mistake: Callable[[np.ndarray], np.ndarray], said: str
) -> None:
    refused = in_order(at_stops, tmp_path, mistake(at_stops.exact))
    assert refused.exit_code == 2
    assert re.search(said, refused.text)


@pytest.mark.slow  # The poses are those of the test before, by another way.
def test_eye_to_hand_that_is_missing_is_refused_in_the_same_words(
    at_stops: Recorded, tmp_path: Path
) -> None:
    refused = import_png(at_stops.with_camera_fixed(), tmp_path)
    assert refused.exit_code == 2
    assert "--eye-to-hand" in refused.text


def test_an_image_dropped_in_the_middle_of_a_list_is_named(
    at_stops: Recorded, tmp_path: Path
) -> None:
    count = len(at_stops.exact)
    dropped = count // 2
    kept = np.delete(np.arange(count), dropped)
    refused = in_order(at_stops.take(kept), tmp_path, at_stops.exact[:-1])
    assert refused.exit_code == 2
    # Images after it have the pose of the stop before.
    assert f" images, '{dropped}' to " in refused.text
    assert "lie on the walls with the poses shifted by -1" in refused.text


@pytest.mark.parametrize(
    ("spoilt", "said"),
    [
        (
            lambda images: replace(images, depth_mm=images.depth_mm[:, :, ::-1]),
            "mm with the columns mirrored",
        ),
        pytest.param(
            lambda images: replace(images, depth_mm=images.amplitude, amplitude=images.depth_mm),
            "swap --depth and --amplitude",
            marks=pytest.mark.slow,
        ),
    ],
    ids=["mirrored", "exchanged"],
)
def test_wrong_images_are_refused_with_both_numbers(
    at_stops: Recorded, tmp_path: Path, spoilt: Callable[[Recorded], Recorded], said: str
) -> None:
    refused = in_order(spoilt(at_stops), tmp_path, at_stops.exact)
    assert refused.exit_code == 2
    assert said in refused.text


def test_millimetres_read_as_metres_are_refused_with_the_depth_that_shows_it(
    at_stops: Recorded, tmp_path: Path
) -> None:
    scene_files.write_numbered(at_stops, tmp_path, "npy")
    for path in (tmp_path / "depth").iterdir():
        np.save(path, np.load(path) * 1e3)
    poses = scene_files.write_matrices(at_stops.exact, tmp_path / "poses.txt")
    refused = import_written(at_stops, tmp_path, "npy", poses)
    median = float(np.median([np.median(d[d > 0]) for d in at_stops.depth_mm]))
    assert f"the median depth is {median:.4g} m" in refused.text
    assert "--depth-unit-mm 1" in refused.text
    undone = import_written(at_stops, tmp_path, "npy", poses, "--depth-unit-mm", 1)
    assert undone.exit_code == 0


def test_depth_of_8_bits_is_refused(at_stops: Recorded, tmp_path: Path) -> None:
    (tmp_path / "depth").mkdir()
    for number, image in enumerate(at_stops.depth_mm):
        cv2.imwrite(str(tmp_path / "depth" / f"{number}.png"), (image // 16).astype(np.uint8))
    poses = scene_files.write_matrices(at_stops.exact, tmp_path / "poses.txt")
    refused = run_import(
        "frames", tmp_path, "--depth", "depth/*.png", "--poses", poses, "--focal", "45", "--centre",
        "24,18", out=tmp_path / "out",
    )  # fmt: skip
    assert refused.exit_code == 2
    assert "8 bits a pixel" in refused.text


def test_an_amplitude_of_8_bits_is_refused_and_says_what_it_is_good_for(
    at_stops: Recorded, tmp_path: Path
) -> None:
    scene_files.write_numbered(at_stops, tmp_path, "npy")
    for path in (tmp_path / "ir").iterdir():
        np.save(path, (np.load(path) // 32).astype(np.uint8))
    poses = scene_files.write_matrices(at_stops.exact, tmp_path / "poses.txt")
    refused = import_written(at_stops, tmp_path, "npy", poses)
    assert "expected 16 bits or floats as amplitude" in refused.text


def test_missing_intrinsics_and_those_of_another_size_are_refused(
    at_stops: Recorded, tmp_path: Path
) -> None:
    scene_files.write_png(at_stops, tmp_path)
    poses = scene_files.write_tum(at_stops.image_times, at_stops.exact, tmp_path / "poses.txt")
    given = ("--depth", "depth/*.png", "--poses", poses)
    without = run_import("frames", tmp_path, *given, out=tmp_path / "out")
    assert "say where the intrinsics come from" in without.text
    camera = tmp_path / "camera.yaml"
    camera.write_text("{width: 640, height: 480, fx: 600, fy: 600, cx: 320, cy: 240}")
    other = run_import("frames", tmp_path, *given, "--intrinsics", camera, out=tmp_path / "out")
    width, height = at_stops.size
    said = f"the intrinsics hold for 640x480 pixels, the images have {width}x{height}"
    assert said in other.text


@pytest.mark.slow
@pytest.mark.parametrize("late", [3.0, -4.6])
def test_a_clock_that_is_seconds_late_is_refused_with_the_offset_that_mends_it(
    drive: Recorded, tmp_path: Path, late: float
) -> None:
    refused = import_png(drive.stamped_late(late), tmp_path)
    assert refused.exit_code == 2
    assert f"{abs(late):.1f} s {'late' if late > 0 else 'early'}" in refused.text
    assert f"add --time-offset-s {-late:.1f}" in refused.text


def test_distances_in_another_unit_are_refused_with_the_factor(
    at_stops: Recorded, tmp_path: Path
) -> None:
    refused = import_png(at_stops, tmp_path, "--depth-unit-mm", 10)
    assert refused.exit_code == 2
    assert "all distances multiplied by 0.1: is --depth-unit-mm right?" in refused.text


def test_clocks_that_share_no_time_are_refused_with_their_difference(
    at_stops: Recorded, tmp_path: Path
) -> None:
    refused = import_png(at_stops.stamped_late(5e4), tmp_path)
    assert "they share no time" in refused.text
    assert "--time-offset-s" in refused.text
    undone = import_png(at_stops.stamped_late(5e4), tmp_path / "again", "--time-offset-s", -5e4)
    assert undone.exit_code == 0
