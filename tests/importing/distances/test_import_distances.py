"""Rows of distances beside poses become images of one or a few pixels."""

from pathlib import Path

import numpy as np
import pytest
from importing.frames.imported import run_import
from importing.posed_scene import FRONT, Drive, Recorded
from importing.scene_files import write_matrices
from importing.walls.wall_trials import WALLS, read_trial


def test_real_trials_become_distances_beside_their_poses(real_data: Path, tmp_path: Path) -> None:
    named = [word for wall in WALLS for word in ("--wall", wall)]
    folders = [real_data / "wall_trials_l3cx" / f"L3CX_{wall}_P1" for wall in WALLS]
    given = (*folders, *named, "--depth-unit-mm", 1)
    imported = run_import("distances", *given, out=tmp_path / "out")
    recording = imported.done
    assert "a turn about it cannot be found" in imported.text
    assert recording.planes == "estimated"
    for wall in WALLS:
        poses, distance = read_trial(real_data, wall, "P1")
        own = recording.frames.target == wall
        np.testing.assert_allclose(recording.depth[own, 0, 0], distance, atol=1e-6)
        found = recording.frames.world_from_tool[own]
        np.testing.assert_allclose(found, poses, atol=1e-5)


@pytest.fixture(scope="module")
def zones() -> Recorded:
    """A sensor of 8 x 8 zones before one wall."""
    drive = Drive(stops=24, width=8, height=8, planes=(FRONT,), distortion=(), error=0.2, rate=4)
    recorded = drive.record().one_a_stop()
    return recorded.take(np.all(recorded.depth_mm > 0, axis=(1, 2)))


def write_rows(recorded: Recorded, path: Path, *, factor: float, repeats: int) -> Path:
    rows = recorded.depth_mm.reshape(len(recorded.depth_mm), -1) * factor
    lines = [
        f"2024-01-01T10:00:{k:02d}, " + ", ".join(f"{v:g}" for _ in range(repeats) for v in row)
        for k, row in enumerate(rows)
    ]
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return path


@pytest.mark.parametrize(("factor", "word"), [(1.0, "millimetres"), (1e-3, "metres")])
def test_eight_by_eight_zones_are_read_in_either_unit_which_is_named(
    zones: Recorded, tmp_path: Path, factor: float, word: str
) -> None:
    rows = write_rows(zones, tmp_path / "north.csv", factor=factor, repeats=3)
    poses = write_matrices(zones.exact, tmp_path / "poses.txt")
    arguments = (rows, "--poses", poses, "--zones", "8x8", "--fov-deg", "55.6")
    imported = run_import("distances", *arguments, out=tmp_path / "out")
    recording = imported.done
    assert f"read as {word}" in imported.text
    assert set(recording.frames.target) == {"north"}
    np.testing.assert_allclose(recording.depth, zones.depth_mm / 1e3, atol=1e-6)


def test_readings_of_a_row_that_scatter_are_named(zones: Recorded, tmp_path: Path) -> None:
    """A median of readings hid that they were 113 mm apart, where those of others were 2 mm."""
    wall, poses = tmp_path / "north.csv", write_matrices(zones.exact, tmp_path / "poses.txt")
    readings = [[v - 1, v + 1] for v in zones.depth_mm[:, 4, 4]]
    readings[3][1] += 224
    wall.write_text("\n".join(f"2024-01-01T10:00:00, {a}, {b}" for a, b in readings))
    said = run_import("distances", wall, "--poses", poses, out=tmp_path / "out").text
    assert "row 3 of north scatter by 113 mm, of most by 1 mm" in said


def test_rows_without_whole_readings_and_lists_of_other_lengths_are_refused(
    zones: Recorded, tmp_path: Path
) -> None:
    rows = write_rows(zones, tmp_path / "north.csv", factor=1.0, repeats=1)
    poses = ("--poses", write_matrices(zones.exact[1:], tmp_path / "poses.txt"))
    sensor, odd = (("--zones", size, "--fov-deg", "45") for size in ("8x8", "5x3"))
    count = len(zones.exact)
    for arguments, said in (
        ((rows, *poses, *sensor), f"{count - 1} poses beside {count} rows"),
        ((rows, *poses, *odd), "64 numbers are not whole readings of 15 zones"),
        ((rows, *poses, "--zones", "8x8"), "--fov-deg"),
        ((rows, *sensor), "name its poses with --poses"),
        ((tmp_path, *sensor), "measurements.csv: there is no such file"),
    ):
        assert said in run_import("distances", *arguments, out=tmp_path / "out").text
