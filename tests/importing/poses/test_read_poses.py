"""Pose files of every format hold the poses that other programs meant."""

from pathlib import Path

import numpy as np
import pytest
from cameras import rigid
from optional import present
from scipy.spatial.transform import Rotation

from tofcorr.errors import CalibrationDataError
from tofcorr.importing.pose_files import read_poses

TURN = Rotation.from_rotvec([0.2, -0.5, 0.9])
POSE = rigid(TURN, [0.1, -0.2, 0.3])
X, Y, Z, W = TURN.as_quat()
ROW = " ".join(f"{number:.9f}" for number in POSE.ravel())
AXIS = ",".join(f"{number:.9f}" for number in TURN.as_rotvec())

FILES = {
    "tum.txt": f"# time x y z qx qy qz qw\n1.5 0.1 -0.2 0.3 {X} {Y} {Z} {W}\n",
    "quaternion.csv": f"timestamp_ms,tx,ty,tz,qx,qy,qz,qw\n1500,0.1,-0.2,0.3,{X},{Y},{Z},{W}\n",
    "universal.csv": f"time,x_mm,y_mm,z_mm,rx,ry,rz\n1.5,100,-200,300,{AXIS}\n",
    "nanoseconds.csv": f"timestamp_ns,px,py,pz,rx,ry,rz\n1500000000,0.1,-0.2,0.3,{AXIS}\n",
    "stamped.txt": f"1.5 {ROW}\n",
    "rows.txt": f"{ROW.replace(' ', ', ')},\n",
    "twelve.txt": " ".join(ROW.split()[:12]) + "\n",
    "blocks.txt": "\n".join(" ".join(ROW.split()[k : k + 4]) for k in (0, 4, 8, 12)) + "\n",
    "euroc.csv": "#timestamp [ns], p_RS_R_x [m], p_RS_R_y [m], p_RS_R_z [m], q_RS_w [], q_RS_x [], "
    f"q_RS_y [], q_RS_z []\n1500000000,0.1,-0.2,0.3,{W},{X},{Y},{Z}\n",
    "units.csv": f"time [s],x [mm],y [mm],z [mm],qx,qy,qz,qw\n1.5,100,-200,300,{X},{Y},{Z},{W}\n",
    "excel.csv": f"# a comment\ntime;x;y;z;qx;qy;qz;qw\n1.5;0.1;-0.2;0.3;{X};{Y};{Z};{W}\n".replace(
        ".", ","
    ),
    "ros1.csv": "%time,field.header.stamp,field.pose.position.x,field.pose.position.y,"
    "field.pose.position.z,field.pose.orientation.x,field.pose.orientation.y,"
    f"field.pose.orientation.z,field.pose.orientation.w\n1.6,1.5,0.1,-0.2,0.3,{X},{Y},{Z},{W}\n",
    "ros2.csv": "header.stamp.sec,header.stamp.nanosec,child_frame_id,transform.translation.x,"
    "transform.translation.y,transform.translation.z,transform.rotation.x,transform.rotation.y,"
    f"transform.rotation.z,transform.rotation.w\n1,500000000,tool,0.1,-0.2,0.3,{X},{Y},{Z},{W}\n",
    "samples.yaml": f"- effector_wrt_world: [{', '.join(ROW.split())}]\n  object_wrt_sensor: []\n",
}


@pytest.mark.parametrize("name", FILES)
def test_every_format_holds_the_pose(name: str, tmp_path: Path) -> None:
    path = tmp_path / name
    path.write_text(FILES[name], encoding="utf-8")
    track = read_poses(path)
    np.testing.assert_allclose(track.world_from_tool, POSE[None], atol=1e-8)
    stamped = name in ("tum.txt", "stamped.txt") or name.endswith(".csv")
    assert track.timestamp == ([1.5] if stamped else None)


@pytest.mark.parametrize("name", ["poses.txt", "poses.csv"])
@pytest.mark.parametrize("unit", [1e-3, 1e-6, 1e-9])
def test_stamps_since_1970_may_count_finer_units(name: str, unit: float, tmp_path: Path) -> None:
    """TUM's lines and a column `timestamp` in nanoseconds were read as seconds."""
    row = f"{round(1_700_000_000.5 / unit)} 0.1 -0.2 0.3 {X} {Y} {Z} {W}\n"
    header = "timestamp,x,y,z,qx,qy,qz,qw\n"
    path = tmp_path / name
    path.write_text(row if name.endswith(".txt") else header + row.replace(" ", ","), "utf-8")
    stamps = present(read_poses(path).timestamp)
    np.testing.assert_allclose(stamps, [1_700_000_000.5], rtol=0, atol=1e-6)


def test_a_comment_that_names_columns_leaves_a_trajectory_of_tum_what_it_is(tmp_path: Path) -> None:
    path = tmp_path / "poses.txt"
    path.write_text("# timestamp,tx,ty,tz,qx,qy,qz,qw\n" + FILES["tum.txt"], encoding="utf-8")
    np.testing.assert_allclose(read_poses(path).world_from_tool, POSE[None], atol=1e-8)


def test_a_folder_with_a_matrix_a_file_names_its_poses(tmp_path: Path) -> None:
    np.savetxt(tmp_path / "a.txt", POSE)
    np.save(tmp_path / "b.npy", np.eye(4))
    track = read_poses(tmp_path)
    assert track.names == ("a", "b")
    np.testing.assert_allclose(track.world_from_tool, [POSE, np.eye(4)], atol=1e-12)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("1 0 0 0 0 0 0 2\n", "line 1: the quaternion .* has length 2"),
        ("2 0 0 0 0 0 0 1\n1 0 0 0 0 0 0 1\n", "expected increasing times"),
        ("1 0 0 0 0 0 0 1\n1 9 0 0 0 0 0 1\n", "repeats the time 1.000000 s"),
        ("1 0 0 0 0 0 0 1\n2 0 0 x 0 0 0 1\n", "line 2: expected 8 finite numbers, got .*x"),
        ("1 2 3\n", "line 1 has 3 numbers; expected 8"),
        ("# nothing\n", "found none"),
        ("tx,ty,tz\n0,0,0\n", "expected qx, qy, qz, qw or rx, ry, rz"),
        ("x,y,z,roll,pitch,yaw\n0,0,0,1,2,3\n", "Turn roll, pitch and yaw into quaternions"),
        ("x,y,z,rx,ry,rz\n0,0,0,90,0,45\n", "row 1: rx, .* times radians, here 100.6"),
        ("a.position.x,x,y,z\n0,0,0,0\n", "two columns are 'x'"),
        (ROW.replace(ROW.split()[0], "3.0", 1) + "\n", "pose 0: .*rotation"),
    ],
)
def test_what_is_wrong_is_named_with_its_line(text: str, said: str, tmp_path: Path) -> None:
    path = tmp_path / "poses.txt"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(CalibrationDataError, match=said):
        read_poses(path)
