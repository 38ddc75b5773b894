"""Pose files of every format hold the poses that other programs meant."""

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tofcorr.errors import CalibrationDataError
from tofcorr.importing.poses.read import read_poses

TURN = Rotation.from_rotvec([0.2, -0.5, 0.9])
POSE = np.eye(4)
POSE[:3, :3] = TURN.as_matrix()
POSE[:3, 3] = [0.1, -0.2, 0.3]
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
    "samples.yaml": f"- effector_wrt_world: [{', '.join(ROW.split())}]\n  object_wrt_sensor: []\n",
}


@pytest.mark.parametrize("name", FILES)
def test_every_format_holds_the_pose(name: str, tmp_path: Path) -> None:
    path = tmp_path / name
    path.write_text(FILES[name], encoding="utf-8")
    track = read_poses(path)
    np.testing.assert_allclose(track.world_from_tool, POSE[None], atol=1e-8)
    stamped = name in ("tum.txt", "stamped.txt") or name.endswith(".csv")
    assert (None if track.timestamp is None else list(track.timestamp)) == (
        [1.5] if stamped else None
    )


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
        ("2 0 0 0 0 0 0 1\n1 0 0 0 0 0 0 1\n", "expected times that increase"),
        ("1 0 0 0 0 0 0 1\n1 9 0 0 0 0 0 1\n", "carry the same time stamp"),
        ("1 0 0 0 0 0 0 1\n2 0 0 x 0 0 0 1\n", "line 2: expected numbers"),
        ("1 2 3\n", "the format is not recognised: 3 numbers"),
        ("# nothing\n", "found none"),
        ("tx,ty,tz\n0,0,0\n", "expected the columns qx, qy, qz, qw or rx, ry, rz"),
        (ROW.replace(ROW.split()[0], "3.0", 1) + "\n", "pose 0: .*rotation"),
    ],
)
def test_what_is_wrong_is_named_with_its_line(text: str, said: str, tmp_path: Path) -> None:
    path = tmp_path / "poses.txt"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(CalibrationDataError, match=said):
        read_poses(path)
