"""The table of frames: any pose survives it, and other programs' tables are read alike."""

import csv
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from broken_recordings import cells
from cameras import rigid
from hypothesis import given, settings
from hypothesis import strategies as st
from optional import present
from scipy.spatial.transform import Rotation

from tofcorr.data.recording import Recording
from tofcorr.data.table import FrameRow, read_table, table_text
from tofcorr.errors import CalibrationDataError


def test_an_empty_optional_cell_is_unknown_and_not_zero(folder: Path) -> None:
    ambient = present(Recording.open(folder).frames.ambient)
    np.testing.assert_array_equal(np.isnan(ambient), [False, True] + 4 * [False])
    assert Recording.open(folder).frames.row(1).ambient is None


# A rotation goes through a quaternion and back: some units in the last place of float64.
ROUNDING = 1e-14


def test_rows_taken_from_a_table_give_the_same_table(folder: Path, tmp_path: Path) -> None:
    table = Recording.open(folder).frames
    chosen = table.select([4, 1])
    (tmp_path / "frames.csv").write_text(table_text(chosen.rows()))
    again = read_table(tmp_path / "frames.csv")
    np.testing.assert_allclose(again.world_from_tool, table.world_from_tool[[4, 1]], atol=ROUNDING)
    for name in ("integration_time", "ambient", "target"):
        np.testing.assert_array_equal(getattr(again, name), getattr(table, name)[[4, 1]])


def test_a_table_from_windows_with_more_columns_in_any_order_is_read_alike(folder: Path) -> None:
    before = Recording.open(folder).frames
    path = folder / "frames.csv"
    with path.open(newline="") as file:
        rows = list(csv.DictReader(file))
    names = ["operator", *reversed(rows[0])]
    with path.open("w", newline="", encoding="utf-8-sig") as file:
        writer = csv.DictWriter(file, names, lineterminator="\r\n")
        writer.writeheader()
        writer.writerows([{**row, "operator": "Müller, A."} for row in rows])
        file.write("\r\n")
    header = (folder / "recording.yaml").read_bytes()
    windows = b"\xef\xbb\xbf" + header.replace(b"\n", b"\r\n") + b"operator: someone\r\n"
    (folder / "recording.yaml").write_bytes(windows)

    after = Recording.open(folder).frames

    for name in ("world_from_tool", "ambient", "target"):
        np.testing.assert_array_equal(getattr(after, name), getattr(before, name))


def test_quaternions_have_their_scalar_last_and_normals_are_normalised(folder: Path) -> None:
    # A quarter turn about z: x goes to y.
    half = 0.5**0.5
    cells(2, qx="0", qy="0", qz=repr(half), qw=repr(half))(folder)
    rotation = Recording.open(folder).frames.world_from_tool[2, :3, :3]
    np.testing.assert_allclose(rotation @ [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], atol=1e-15)
    cells(3, nx="0", ny="0", nz="-1.0005", d="2.001")(folder)
    table = Recording.open(folder).frames
    np.testing.assert_array_equal(table.normal_world[3], [0.0, 0.0, -1.0])
    assert table.offset[3] == pytest.approx(2.0, rel=1e-15)  # -z + 2 = 0: the plane z = 2.


@settings(max_examples=30, deadline=None)
@given(
    quaternion=st.tuples(*4 * [st.floats(-1, 1)]).filter(lambda q: np.linalg.norm(q) > 0.1),
    metres=st.floats(-1e3, 1e3),
    microseconds=st.floats(1e-3, 1e9),
)
def test_any_pose_and_time_survive_the_table(
    tmp_path_factory: pytest.TempPathFactory,
    quaternion: tuple[float, float, float, float],
    metres: float,
    microseconds: float,
) -> None:
    pose = rigid(Rotation.from_quat(quaternion), metres)
    seconds = microseconds * 1e-6
    of_frame: dict[str, Any] = {"normal_world": pose[2, :3], "offset": metres, "target": 'a, "b"'}
    of_frame |= {"timestamp": metres, "integration_time": seconds}
    row = FrameRow(world_from_tool=pose, **of_frame)
    path = tmp_path_factory.mktemp("table") / "frames.csv"
    path.write_text(table_text([row]))
    table = read_table(path)
    np.testing.assert_allclose(table.world_from_tool[0], pose, atol=ROUNDING)
    # Fifteen digits are written of a time in microseconds.
    np.testing.assert_allclose(present(table.integration_time), [seconds], rtol=1e-14)
    assert (table.offset[0], table.timestamp[0]) == (pytest.approx(metres, rel=1e-14), metres)
    assert table.target[0] == 'a, "b"'


def test_covariances_of_planes_survive_the_table_and_others_are_refused(tmp_path: Path) -> None:
    root = np.random.default_rng(0).normal(size=(2, 4, 4))
    known, pose, path = root @ root.transpose(0, 2, 1), np.eye(4), tmp_path / "frames.csv"
    plane: dict[str, Any] = {"normal_world": pose[2, :3], "offset": 1.0, "target": "white"}
    plane |= {"world_from_tool": pose, "timestamp": 0.0}
    path.write_text(table_text([FrameRow(**plane, plane_covariance=one) for one in known]))
    np.testing.assert_array_equal(read_table(path).plane_covariance, known)
    text = path.read_text()
    for lost in ("nx_nx", "nz_d"):
        path.write_text(text.replace(f",{lost},", ",other,"))
        with pytest.raises(CalibrationDataError, match=f"column '{lost}' is missing"):
            read_table(path)
    path.write_text(text.replace(repr(float(known[1, 3, 3])), "-1.0"))
    with pytest.raises(CalibrationDataError, match="frame 1: nx_nx to d_d are no covariance"):
        read_table(path)


def test_joint_angles_survive_the_table_and_gaps_are_refused(tmp_path: Path) -> None:
    place = {"world_from_tool": np.eye(4), "normal_world": np.array([0.0, 0, 1]), "offset": 0.0}
    angles, path = np.random.default_rng(1).normal(size=(3, 11)), tmp_path / "frames.csv"
    rows = [FrameRow(timestamp=0.0, target="white", **place, joint_angles=one) for one in angles]
    path.write_text(table_text(rows))
    table = read_table(path)
    np.testing.assert_array_equal(table.joint_angles, angles)
    np.testing.assert_array_equal(table.row(1).joint_angles, angles[1])
    path.write_text(path.read_text().replace("joint_3,", "elbow,"))
    with pytest.raises(CalibrationDataError, match="column 'joint_3' is missing beside joint_1"):
        read_table(path)
    path.write_text(table_text([*rows, replace(rows[0], joint_angles=None)]))
    assert read_table(path).joint_angles is None
