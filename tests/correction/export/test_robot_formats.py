"""Robots read the calibrated pose of the camera: each format, read by a reader of its own."""

import math
import re
import shlex
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple
from xml.etree import ElementTree

import numpy as np
import pytest
import yaml
from correction.export.states import EYE_TO_HAND, NAMES, TRANSFORMS, calibration, write
from optional import present
from scipy.spatial.transform import Rotation

from tofcorr.correction.state import HandEyeAccuracy
from tofcorr.errors import ConfigError
from tofcorr.geometry.camera import FrameNames

every_transform = pytest.mark.parametrize("transform", TRANSFORMS.values(), ids=TRANSFORMS)


class Pose(NamedTuple):
    """What a robot's program makes of a file."""

    translation: list[float]
    rotation: np.ndarray
    frames: Sequence[str | None]


def rotation_of_rpy(roll: float, pitch: float, yaw: float) -> np.ndarray:
    """R = Rz(yaw) Ry(pitch) Rx(roll), as the URDF specification defines `rpy`."""
    (cr, sr), (cp, sp), (cy, sy) = ((math.cos(a), math.sin(a)) for a in (roll, pitch, yaw))
    about_x = np.array([[1, 0, 0], [0, cr, -sr], [0, sr, cr]])
    about_y = np.array([[cp, 0, sp], [0, 1, 0], [-sp, 0, cp]])
    about_z = np.array([[cy, -sy, 0], [sy, cy, 0], [0, 0, 1]])
    return about_z @ about_y @ about_x


def by_urdf(text: str) -> Pose:
    robot = ElementTree.fromstring(text)
    joint = present(robot.find("joint"))
    assert robot.tag == "robot"
    assert joint.get("type") == "fixed"
    frames = [joint.find(tag).get("link") for tag in ("parent", "child")]  # type: ignore[union-attr]
    assert [link.get("name") for link in robot.findall("link")] == frames[1:]
    origin = present(joint.find("origin"))
    xyz, rpy = ([float(word) for word in origin.attrib[key].split()] for key in ("xyz", "rpy"))
    return Pose(xyz, rotation_of_rpy(*rpy), frames)


def by_commands(text: str) -> Pose:
    values = yaml.safe_load(text)
    # Each command stands on one line, to be copied.
    (line,) = [one.strip() for one in text.splitlines() if one.strip().startswith("ros2 run")]
    ros1, ros2 = shlex.split(values["commands"]["ros1"]), shlex.split(line)
    assert ros2[:4] == ["ros2", "run", "tf2_ros", "static_transform_publisher"]
    given = dict(zip(ros2[4::2], ros2[5::2], strict=True))
    numbers = [float(given[f"--{name}"]) for name in ("x", "y", "z", "qx", "qy", "qz", "qw")]
    frames = [given["--frame-id"], given["--child-frame-id"]]
    assert [float(word) for word in ros1[3:10]] == numbers
    assert ros1[10:] == frames
    # As geometry_msgs/TransformStamped has it.
    stamped = of_message(values["transform"])
    assert [values["header"]["frame_id"], values["child_frame_id"]] == frames
    assert len(values["standard_errors"]["translation_mm"]) == 3
    rotation = Rotation.from_quat(numbers[3:]).as_matrix()
    np.testing.assert_allclose(stamped.translation, numbers[:3], atol=1e-9)
    np.testing.assert_allclose(stamped.rotation, rotation, atol=1e-8)
    return Pose(numbers[:3], rotation, frames)


def of_message(transform: Mapping[str, Any]) -> Pose:
    rotation = Rotation.from_quat([transform["rotation"][axis] for axis in "xyzw"]).as_matrix()
    return Pose([transform["translation"][axis] for axis in "xyz"], rotation, [])


FRAMES = {"robot_base_frame", "robot_effector_frame", "tracking_base_frame"}
FRAMES |= {"tracking_marker_frame", "move_group_namespace", "move_group"}


def by_easy_handeye(text: str) -> Pose:
    values = yaml.safe_load(text)
    parameters, found = values["parameters"], values["transformation"]
    # Its class takes exactly these as arguments, and fails on any other.
    assert set(parameters) == FRAMES | {"namespace", "eye_on_hand"}
    # Its publisher's choice of the parent frame.
    carrier = "robot_effector_frame" if parameters["eye_on_hand"] else "robot_base_frame"
    rotation = Rotation.from_quat([found[key] for key in ("qx", "qy", "qz", "qw")]).as_matrix()
    frames = [parameters[carrier], parameters["tracking_base_frame"]]
    return Pose([found[axis] for axis in "xyz"], rotation, frames)


def by_easy_handeye2(text: str) -> Pose:
    values = yaml.safe_load(text)
    # The fields of its messages HandeyeCalibration and HandeyeCalibrationParameters; an unknown
    # one ends its publisher.
    assert set(values) == {"parameters", "transform"}
    parameters = values["parameters"]
    assert set(parameters) == FRAMES | {"name", "calibration_type", "freehand_robot_movement"}
    assert parameters["name"] == "camera"
    in_hand = {"eye_in_hand": True, "eye_on_base": False}[parameters["calibration_type"]]
    carrier = "robot_effector_frame" if in_hand else "robot_base_frame"
    frames = [parameters[carrier], parameters["tracking_base_frame"]]
    return of_message(values["transform"])._replace(frames=frames)


READERS = {
    ("urdf", "camera.urdf.xacro"): by_urdf,
    ("tf", "camera.yaml"): by_commands,
    ("easy_handeye", "camera.yaml"): by_easy_handeye,
    ("easy_handeye", "camera.calib"): by_easy_handeye2,
}
every_format = pytest.mark.parametrize(("name", "file"), READERS)
QUOTED = FrameNames(world="w", tool='left arm\'s <tool> & "co"', camera="cam--1: # ü")


@every_format
@pytest.mark.parametrize("names", [NAMES, EYE_TO_HAND, QUOTED], ids=["in hand", "to hand", "odd"])
@every_transform
def test_a_robot_reads_the_calibrated_pose(
    transform: np.ndarray, names: FrameNames, name: str, file: str, tmp_path: Path
) -> None:
    write(name, calibration(transform, frames=names), tmp_path / file)
    found = READERS[name, file]((tmp_path / file).read_text(encoding="utf-8"))
    np.testing.assert_allclose(np.array(found.translation, float), transform[:3, 3], atol=1e-9)
    np.testing.assert_allclose(found.rotation, transform[:3, :3], atol=1e-8)
    assert list(found.frames) == [names.tool, names.camera]


@every_format
def test_a_reader_sees_axes_and_standard_errors(name: str, file: str, tmp_path: Path) -> None:
    accuracy = HandEyeAccuracy(
        translation_se_mm=(0.1, 0.2, 0.3), rotation_se_deg=(0.01, 0.02, 0.03), undetermined=("t_z",)
    )
    state = calibration(TRANSFORMS["general"], hand_eye_accuracy=accuracy)
    write(name, state, tmp_path / file)
    text = (tmp_path / file).read_text()
    assert "x right, y down, z forward" in text
    assert "0.100 0.200 0.300 mm" in text
    assert "0.0100 0.0200 0.0300 deg" in text
    assert re.search(r"NOT DETERMINED.*: t_z\.", text)


@every_format
def test_a_calibration_without_a_robot_is_refused(name: str, file: str, tmp_path: Path) -> None:
    state = calibration(np.eye(4), hand_eye_estimated=False)
    with pytest.raises(ConfigError, match=rf"{name} needs an estimated.*EA has none"):
        write(name, state, tmp_path / file)
    assert list(tmp_path.iterdir()) == []


def test_another_ending_than_easy_handeye_loads_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"\.yaml.*\.calib"):
        write("easy_handeye", calibration(np.eye(4)), tmp_path / "arm.json")
