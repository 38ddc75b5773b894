"""Robots read the calibrated pose of the camera: each format, read by a reader of its own."""

import math
import re
import shlex
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pytest
import yaml
from correction.export.states import (
    ACCURACY,
    EYE_TO_HAND,
    TRANSFORMS,
    calibration,
    write,
)
from scipy.spatial.transform import Rotation

from tofcorr.correction.state import HandEyeAccuracy
from tofcorr.errors import ConfigError, ExportError
from tofcorr.geometry.camera import FrameNames

POSE_FORMATS = [
    ("urdf", "camera.urdf.xacro"),
    ("tf", "camera.yaml"),
    ("easy_handeye", "camera.yaml"),
    ("easy_handeye", "camera.calib"),
]
every_transform = pytest.mark.parametrize("transform", TRANSFORMS.values(), ids=TRANSFORMS)


def rotation_of_rpy(roll: float, pitch: float, yaw: float) -> np.ndarray:
    """R = Rz(yaw) Ry(pitch) Rx(roll), as the URDF specification defines `rpy`."""
    (cr, sr), (cp, sp), (cy, sy) = ((math.cos(a), math.sin(a)) for a in (roll, pitch, yaw))
    about_x = np.array([[1, 0, 0], [0, cr, -sr], [0, sr, cr]])
    about_y = np.array([[cp, 0, sp], [0, 1, 0], [-sp, 0, cp]])
    about_z = np.array([[cy, -sy, 0], [sy, cy, 0], [0, 0, 1]])
    return about_z @ about_y @ about_x


def assert_same(translation: Any, rotation: np.ndarray, transform: np.ndarray) -> None:
    np.testing.assert_allclose(np.asarray(translation, float), transform[:3, 3], atol=1e-9)
    np.testing.assert_allclose(rotation, transform[:3, :3], atol=1e-8)


@every_transform
def test_urdf_joint_carries_the_camera_where_it_is(transform: np.ndarray, tmp_path: Path) -> None:
    write("urdf", calibration(transform), tmp_path / "camera.xacro")
    robot = ElementTree.parse(tmp_path / "camera.xacro").getroot()
    joint = robot.find("joint")
    assert robot.tag == "robot"
    assert joint is not None
    assert joint.get("type") == "fixed"
    assert [joint.find(tag).get("link") for tag in ("parent", "child")] == [  # type: ignore[union-attr]
        "tool0",
        "tof_optical_frame",
    ]
    assert [link.get("name") for link in robot.findall("link")] == ["tof_optical_frame"]
    origin = joint.find("origin")
    assert origin is not None
    xyz, rpy = ([float(word) for word in origin.attrib[key].split()] for key in ("xyz", "rpy"))
    assert_same(xyz, rotation_of_rpy(*rpy), transform)


@every_transform
def test_published_transforms_of_both_ros_are_the_calibrated_one(
    transform: np.ndarray, tmp_path: Path
) -> None:
    write("tf", calibration(transform), tmp_path / "camera.yaml")
    values = yaml.safe_load((tmp_path / "camera.yaml").read_text())
    ros2 = shlex.split(values["commands"]["ros2"])
    assert ros2[:4] == ["ros2", "run", "tf2_ros", "static_transform_publisher"]
    given = dict(zip(ros2[4::2], ros2[5::2], strict=True))
    assert (given["--frame-id"], given["--child-frame-id"]) == ("tool0", "tof_optical_frame")
    numbers = [float(given[f"--{name}"]) for name in ("x", "y", "z", "qx", "qy", "qz", "qw")]
    assert_same(numbers[:3], Rotation.from_quat(numbers[3:]).as_matrix(), transform)
    ros1 = shlex.split(values["commands"]["ros1"])
    assert [float(word) for word in ros1[3:10]] == numbers
    assert ros1[10:] == ["tool0", "tof_optical_frame"]
    # As geometry_msgs/TransformStamped has it.
    assert values["header"]["frame_id"] == "tool0"
    stamped = values["transform"]
    rotation = Rotation.from_quat([stamped["rotation"][axis] for axis in "xyzw"]).as_matrix()
    assert_same([stamped["translation"][axis] for axis in "xyz"], rotation, transform)
    assert values["standard_errors"]["translation_mm"] == list(ACCURACY.translation_se_mm)


def test_the_command_to_publish_stands_on_one_line(tmp_path: Path) -> None:
    write("tf", calibration(TRANSFORMS["general"]), tmp_path / "camera.yaml")
    lines = [line.strip() for line in (tmp_path / "camera.yaml").read_text().splitlines()]
    whole = [line for line in lines if line.startswith("ros2 run")]
    assert len(whole) == 1
    assert whole[0].endswith("--child-frame-id tof_optical_frame")


@every_transform
@pytest.mark.parametrize("names", [None, EYE_TO_HAND], ids=["in hand", "to hand"])
def test_easy_handeye_publishes_the_calibrated_transform(
    names: FrameNames | None, transform: np.ndarray, tmp_path: Path
) -> None:
    state = calibration(transform, **({} if names is None else {"frames": names}))
    write("easy_handeye", state, tmp_path / "arm.yaml")
    values = yaml.safe_load((tmp_path / "arm.yaml").read_text())
    # Its class takes exactly these as arguments, and fails on any other.
    allowed = {"namespace", "move_group_namespace", "move_group", "eye_on_hand"}
    allowed |= {"robot_base_frame", "robot_effector_frame"}
    allowed |= {"tracking_base_frame", "tracking_marker_frame"}
    parameters = values["parameters"]
    assert set(parameters) == allowed
    # Its publisher's choice of the parent frame.
    on_hand = parameters["eye_on_hand"]
    parent = parameters["robot_effector_frame" if on_hand else "robot_base_frame"]
    assert (parent, on_hand) == (("tool0", True) if names is None else ("base_link", False))
    assert parameters["robot_base_frame"] == "base_link"
    assert parameters["tracking_base_frame"] == "tof_optical_frame"
    found = values["transformation"]
    rotation = Rotation.from_quat([found[key] for key in ("qx", "qy", "qz", "qw")]).as_matrix()
    assert_same([found[axis] for axis in "xyz"], rotation, transform)


@pytest.mark.parametrize("names", [None, EYE_TO_HAND], ids=["in hand", "to hand"])
def test_easy_handeye2_publishes_the_calibrated_transform(
    names: FrameNames | None, tmp_path: Path
) -> None:
    transform = TRANSFORMS["general"]
    state = calibration(transform, **({} if names is None else {"frames": names}))
    write("easy_handeye", state, tmp_path / "arm.calib")
    values = yaml.safe_load((tmp_path / "arm.calib").read_text())
    # The fields of its messages HandeyeCalibration and HandeyeCalibrationParameters; an unknown
    # one ends its publisher.
    assert set(values) == {"parameters", "transform"}
    parameters = values["parameters"]
    allowed = {"name", "calibration_type", "robot_base_frame", "robot_effector_frame"}
    allowed |= {"tracking_base_frame", "tracking_marker_frame", "freehand_robot_movement"}
    assert set(parameters) == allowed | {"move_group_namespace", "move_group"}
    assert parameters["name"] == "arm"
    kind = parameters["calibration_type"]
    parent = parameters["robot_effector_frame" if kind == "eye_in_hand" else "robot_base_frame"]
    expected = ("tool0", "eye_in_hand") if names is None else ("base_link", "eye_on_base")
    assert (parent, kind) == expected
    found = values["transform"]
    rotation = Rotation.from_quat([found["rotation"][axis] for axis in "xyzw"]).as_matrix()
    assert_same([found["translation"][axis] for axis in "xyz"], rotation, transform)


@pytest.mark.parametrize(("name", "file"), POSE_FORMATS)
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


@pytest.mark.parametrize(("name", "file"), POSE_FORMATS)
def test_a_calibration_without_a_robot_is_refused_by_name(
    name: str, file: str, tmp_path: Path
) -> None:
    state = calibration(np.eye(4), hand_eye_estimated=False)
    with pytest.raises(ConfigError, match=rf"{name} export needs.*calibration EA has none"):
        write(name, state, tmp_path / file)
    assert list(tmp_path.iterdir()) == []


def test_another_ending_than_easy_handeye_loads_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"\.yaml.*\.calib"):
        write("easy_handeye", calibration(np.eye(4)), tmp_path / "arm.json")


@pytest.mark.parametrize(("name", "file"), POSE_FORMATS)
def test_names_that_need_quoting_come_through(name: str, file: str, tmp_path: Path) -> None:
    names = FrameNames(world="w", tool='left arm\'s <tool> & "co"', camera="cam--1: # ü")
    write(name, calibration(TRANSFORMS["general"], frames=names), tmp_path / file)
    text = (tmp_path / file).read_text(encoding="utf-8")
    if name == "urdf":
        joint = ElementTree.fromstring(text).find("joint")
        assert joint is not None
        found = [joint.find(tag).get("link") for tag in ("parent", "child")]  # type: ignore[union-attr]
    elif name == "tf":
        found = shlex.split(yaml.safe_load(text)["commands"]["ros1"])[-2:]
    else:
        parameters = yaml.safe_load(text)["parameters"]
        found = [parameters["robot_effector_frame"], parameters["tracking_base_frame"]]
    assert found == [names.tool, names.camera]


@pytest.mark.parametrize(("name", "file"), POSE_FORMATS)
def test_a_file_that_cannot_be_written_leaves_the_older_one(
    name: str, file: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / file).write_text("older")

    def full(*_: object, **__: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Path, "write_text", full)
    with pytest.raises(ExportError, match="No space left"):
        write(name, calibration(np.eye(4)), tmp_path / file)
    monkeypatch.undo()
    assert [path.read_text() for path in tmp_path.iterdir()] == ["older"]
