"""What is wrong with images and poses is said in one sentence, with the number that shows it."""

import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from importing import scene_files
from importing.frames.imported import Imported, import_png, import_written, run_import
from importing.posed_scene import Recorded
from scipy.spatial.transform import Rotation

from tofcorr.examples import files

SLOW = pytest.mark.slow


def in_order(recorded: Recorded, folder: Path, poses: np.ndarray, *arguments: object) -> Imported:
    """Import images without time stamps, and poses in their order."""
    scene_files.write_numbered(recorded, folder, "npy")
    file = files.write_matrices(poses, folder / "poses.txt")
    return import_written(recorded, folder, "npy", file, *arguments)


def test_right_images_and_poses_raise_no_suspicion(at_stops: Recorded, tmp_path: Path) -> None:
    imported = in_order(at_stops, tmp_path, at_stops.exact)
    assert imported.report["warnings"] == []


def with_poses(undo: Callable[[np.ndarray], np.ndarray]) -> Callable[[Recorded], Recorded]:
    """Return what spoils the poses alone."""
    return lambda recorded: replace(recorded, exact=undo(recorded.exact))


def with_rotations(undo: Callable[[Rotation], Rotation]) -> Callable[[Recorded], Recorded]:
    """Return what spoils the rotations of the poses alone."""

    def spoilt(poses: np.ndarray) -> np.ndarray:
        wrong = poses.copy()
        wrong[:, :3, :3] = undo(Rotation.from_matrix(poses[:, :3, :3])).as_matrix()
        return wrong

    return with_poses(spoilt)


def in_millimetres(poses: np.ndarray) -> np.ndarray:
    wrong = poses.copy()
    wrong[:, :3, 3] *= 1e3
    return wrong


def every_second(recorded: Recorded) -> Recorded:
    """Return half of the images: what all other mistakes are tried before needs no more."""
    return recorded.take(np.arange(0, len(recorded.exact), 2))


@pytest.mark.parametrize(
    ("mistake", "said"),
    [
        (with_poses(np.linalg.inv), "mm if the poses are tool_from_world, .*: invert them"),
        # A few of the images showed a wall by chance, and were written.
        (
            with_rotations(lambda r: Rotation.from_quat(np.roll(r.as_quat(), 1, axis=1))),
            "mm if the quaternions are stored as w, x, y, z: write them as qx, qy, qz, qw",
        ),
        # The same mistake's list as before; half of the poses are shifted in a case below.
        pytest.param(
            with_rotations(Rotation.inv),
            "mm if the rotations are inverted and the translations are not",
            marks=SLOW,
        ),
        pytest.param(
            with_poses(lambda poses: np.roll(poses, -2, axis=0)),
            "poses and images are shifted by 2 rows against each other",
            marks=SLOW,
        ),
        (
            with_poses(lambda poses: np.repeat(poses[:1], len(poses), axis=0)),
            "all poses are the same",
        ),
        (with_poses(lambda poses: poses[1:]), r"\d+ poses and \d+ images"),
        (with_poses(in_millimetres), "mm if the translations are in millimetres"),
        (
            lambda images: replace(every_second(images), depth_mm=images.depth_mm[::2, :, ::-1]),
            "mm if the images are mirrored left to right",
        ),
        (
            lambda images: replace(every_second(images), depth_mm=images.depth_mm[::2] // 10),
            "all distances are multiplied by 10: is --depth-unit-mm right",
        ),
    ],
)
def test_what_is_wrong_is_refused_with_both_numbers(
    at_stops: Recorded, tmp_path: Path, mistake: Callable[[Recorded], Recorded], said: str
) -> None:
    spoilt = mistake(at_stops)
    assert re.search(said, in_order(spoilt, tmp_path, spoilt.exact).refusal)


@pytest.mark.parametrize(
    ("kind", "spoilt", "said"),
    [
        (
            "depth",
            lambda metres: metres * 1e3,
            r"distances are multiplied by 0.001: is --depth-unit-mm",
        ),
        ("depth", lambda metres: (60 * metres).astype(np.uint8), "8 bits a pixel"),
        ("ir", lambda counts: (counts // 32).astype(np.uint8), "16 or floats as amplitude"),
    ],
    ids=["millimetres", "preview", "amplitude"],
)
def test_numbers_of_another_kind_are_refused(
    at_stops: Recorded,
    tmp_path: Path,
    kind: str,
    spoilt: Callable[[np.ndarray], np.ndarray],
    said: str,
) -> None:
    scene_files.write_numbered(at_stops, tmp_path, "npy")
    for path in (tmp_path / kind).iterdir():
        np.save(path, spoilt(np.load(path)))
    poses = files.write_matrices(at_stops.exact, tmp_path / "poses.txt")
    assert re.search(said, import_written(at_stops, tmp_path, "npy", poses).text)
    if "distances" in said:
        assert import_written(at_stops, tmp_path, "npy", poses, "--depth-unit-mm", 1).done


def test_missing_or_other_intrinsics_are_refused(at_stops: Recorded, tmp_path: Path) -> None:
    scene_files.write_png(at_stops, tmp_path)
    poses = files.write_tum(at_stops.image_times, at_stops.exact, tmp_path / "poses.txt")
    given = ("--depth", "depth/*.png", "--poses", poses)
    without = run_import("frames", tmp_path, *given, out=tmp_path / "out")
    assert "say where the intrinsics come from" in without.text
    camera = tmp_path / "camera.yaml"
    camera.write_text("{width: 640, height: 480, fx: 600, fy: 600, cx: 320, cy: 240}")
    other = run_import("frames", tmp_path, *given, "--intrinsics", camera, out=tmp_path / "out")
    width, height = at_stops.size
    said = f"the intrinsics hold for 640x480 pixels, images have {width}x{height}"
    assert said in other.text


@pytest.mark.slow
@pytest.mark.parametrize("late", [3.0, -4.6])
def test_a_clock_that_is_seconds_late_is_refused_with_the_offset_that_mends_it(
    drive: Recorded, tmp_path: Path, late: float
) -> None:
    refused = import_png(drive.stamped_late(late), tmp_path).refusal
    assert f"{abs(late):.1f} s {'late' if late > 0 else 'early'}" in refused
    assert f"add --time-offset-s {-late:.1f}" in refused


def test_clocks_that_share_no_time_are_refused(at_stops: Recorded, tmp_path: Path) -> None:
    refused = import_png(at_stops.stamped_late(5e4), tmp_path)
    assert "they share no time" in refused.text
    assert "--time-offset-s" in refused.text
    assert import_png(at_stops.stamped_late(5e4), tmp_path / "again", "--time-offset-s", -5e4).done
