"""The ROS 2 package as files: what it needs, and the names on which they agree."""

import ast
from xml.etree import ElementTree

from examples.stand_ins import EXAMPLES
from import_graph import imported

PACKAGE = EXAMPLES / "ros2"


def test_the_robot_needs_torch_numpy_and_ros_alone() -> None:
    allowed = {"array", "json", "sys", "typing", "numpy", "torch", "tofcorr_ros"}
    allowed |= {"rclpy", "sensor_msgs", "std_msgs"}
    for path in (PACKAGE / "tofcorr_ros").glob("*.py"):
        assert {name.split(".")[0] for name in imported(path.read_text())} <= allowed, path


def test_package_files_agree_on_names() -> None:
    name = ElementTree.parse(PACKAGE / "package.xml").getroot().findtext("name")
    setup = (PACKAGE / "setup.py").read_text()
    launch = (PACKAGE / "launch" / "correct.launch.py").read_text()
    node = (PACKAGE / "tofcorr_ros" / "node.py").read_text()
    assert name == "tofcorr_ros"
    assert (PACKAGE / "resource" / name).is_file()
    assert f'NAME = "{name}"' in setup
    assert "depth_corrector = {NAME}.node:main" in setup
    assert f'package="{name}"' in launch
    assert 'executable="depth_corrector"' in launch
    for statement in ast.walk(ast.parse(launch)):
        if isinstance(statement, ast.Dict):
            topics = [one.value for one in statement.values if isinstance(one, ast.Constant)]
            assert all(f'"{topic}"' in node for topic in topics)
