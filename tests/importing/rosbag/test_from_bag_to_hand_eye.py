"""From a bag to the URDF of the robot: no board, no guess, nothing but depth, infrared and tf."""

from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
from cameras import apart, rigid
from importing.posed_scene import Drive, Recorded
from importing.rosbag import written_bags
from importing.rosbag.test_import_rosbag import WITH_INFRARED, import_bag
from optional import present
from running import Program
from scipy.spatial.transform import Rotation

NEAR_MM, NEAR_DEG = 1.0, 0.1
"""What is asked of the whole way: a hand-eye transform within 1 mm and 0.1 degrees."""

LAG_NEAR_S = 0.010


def exported_hand_eye(urdf: Path) -> np.ndarray:
    """Read the joint's origin as the URDF specification defines it, shape (4, 4)."""
    origin = present(ElementTree.parse(urdf).find("joint/origin"))
    xyz, rpy = ([float(word) for word in origin.attrib[key].split()] for key in ("xyz", "rpy"))
    return rigid(Rotation.from_euler("xyz", rpy), xyz)


@pytest.fixture(scope="module", params=[0, 2026])
def recorded(request: pytest.FixtureRequest) -> Recorded:
    """40 stops; tf at 10 Hz, images between its stamps; errors of some 10 mm, noise of 3 mm."""
    return Drive(seed=request.param).record()


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["mcap", "ros1"])
@pytest.mark.parametrize("how", ["moving", "standing still", "late"])
def test_the_hand_eye_is_found_wherever_the_camera_is_and_whatever_its_clock(
    kind: str, how: str, recorded: Recorded, tmp_path: Path, program: Program
) -> None:
    """Import, train and export; nothing is known but the bag."""
    late, still = 0.08 if how == "late" else 0.0, how == "standing still"
    drive = recorded.with_camera_fixed() if still else recorded.stamped_late(late)
    path = written_bags.write_drive(drive, tmp_path, kind)
    recording, out, urdf = (tmp_path / name for name in ("recording", "run", "camera.urdf.xacro"))
    options = ("--eye-to-hand",) if still else ()
    imported = import_bag(path, recording, *WITH_INFRARED, *options)
    assert imported.exit_code == 0, imported.text
    train = ("train", "--config", "ea", "--set", "advice=0")
    assert program(*train, "--recording", recording, "--out", out).code == 0
    assert program("export", "--run", out, "--format", "urdf", "--out", urdf).code == 0
    assert (apart(exported_hand_eye(urdf), drive.tool_from_camera) < (NEAR_MM, NEAR_DEG)).all()
    assert abs(imported.report["lag"]["seconds"] - late) < LAG_NEAR_S
