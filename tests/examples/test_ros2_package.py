"""The ROS 2 package as files: what it needs, and the names on which they agree."""

import ast
from xml.etree import ElementTree

from examples.stand_ins import EXAMPLES
from import_graph import imported

PACKAGE = EXAMPLES / "ros2"


ROS = {"rclpy", "sensor_msgs", "std_msgs", "geometry_msgs", "tf2_ros"}


def test_the_corrector_needs_torch_numpy_and_ros_alone() -> None:
    allowed = {"array", "json", "pathlib", "sys", "typing", "numpy", "torch", "tofcorr_ros"}
    for path in (PACKAGE / "tofcorr_ros").glob("*.py"):
        if not path.name.startswith("calibrat"):
            assert {one.split(".")[0] for one in imported(path.read_text())} <= allowed | ROS, path


def test_what_is_calibrated_knows_nothing_of_ros() -> None:
    text = (PACKAGE / "tofcorr_ros" / "calibrating.py").read_text()
    assert not {name.split(".")[0] for name in imported(text)} & ROS


def test_package_files_agree_on_names() -> None:
    name = ElementTree.parse(PACKAGE / "package.xml").getroot().findtext("name")
    setup = (PACKAGE / "setup.py").read_text()
    assert name == "tofcorr_ros"
    assert (PACKAGE / "resource" / name).is_file()
    assert f'NAME = "{name}"' in setup
    assert "depth_corrector = {NAME}.node:main" in setup
    assert "live_calibrator = {NAME}.calibrator:main" in setup
    for started, module in (("correct", "node"), ("calibrate", "calibrator")):
        launch = (PACKAGE / "launch" / f"{started}.launch.py").read_text()
        node = (PACKAGE / "tofcorr_ros" / f"{module}.py").read_text()
        assert f"launch/{started}.launch.py" in setup
        assert f'package="{name}"' in launch
        assert f'"{node.split("super().__init__(")[1].split(chr(34))[1]}"' in launch
        for statement in ast.parse(launch).body:
            if isinstance(statement, ast.Assign):
                said = ast.literal_eval(statement.value)
                words = said.values() if statement.targets[0].id == "TOPICS" else said  # type: ignore[attr-defined]
                assert all(f'"{word}"' in node for word in words)
