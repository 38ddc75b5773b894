"""From a bag to the URDF of the robot: no board, no guess, nothing but depth, infrared and tf."""

from pathlib import Path
from typing import NamedTuple
from xml.etree import ElementTree

import numpy as np
import pytest
from click.testing import CliRunner
from importing.posed_scene import Drive, Recorded, apart
from importing.rosbag import written_bags as bags
from importing.rosbag.test_import_rosbag import WITH_INFRARED, import_bag
from scipy.spatial.transform import Rotation

from tofcorr.cli.main import group

NEAR_MM, NEAR_DEG = 1.0, 0.1
"""What is asked of the whole way: a hand-eye transform within 1 mm and 0.1 degrees."""

LAG_NEAR_S = 0.010

SMALL = Drive(width=32, height=24, rate=5.0)
"""40 stops as in the slow tests, in smaller and fewer images."""


def run(*arguments: object) -> None:
    result = CliRunner().invoke(group, [str(argument) for argument in arguments])
    assert result.exit_code == 0, result.output


def exported_hand_eye(urdf: Path) -> np.ndarray:
    """Read the joint's origin as the URDF specification defines it, shape (4, 4)."""
    origin = ElementTree.parse(urdf).find("joint/origin")
    assert origin is not None
    xyz, rpy = ([float(word) for word in origin.attrib[key].split()] for key in ("xyz", "rpy"))
    transform = np.eye(4)
    transform[:3, :3] = Rotation.from_euler("xyz", rpy).as_matrix()
    transform[:3, 3] = xyz
    return transform


class Found(NamedTuple):
    """How far the exported hand-eye transform is from the truth, and the lag that was found."""

    mm: float
    degrees: float
    lag: float


def find_hand_eye(recorded: Recorded, folder: Path, kind: str, *options: object) -> Found:
    """Import, train and export; nothing is known but the bag."""
    path = bags.write_drive(recorded, folder, kind)
    recording, out, urdf = folder / "recording", folder / "run", folder / "camera.urdf.xacro"
    imported = import_bag(path, recording, *WITH_INFRARED, *options)
    assert imported.exit_code == 0, imported.text
    run("train", "--config", "ea", "--recording", recording, "--out", out, "--set", "advice=0")
    run("export", "--run", out, "--format", "urdf", "--out", urdf)
    mm, degrees = apart(exported_hand_eye(urdf), recorded.tool_from_camera)
    return Found(mm, degrees, imported.report["lag"]["seconds"])


def assert_near(found: Found, late: float = 0.0) -> None:
    assert found.mm < NEAR_MM
    assert found.degrees < NEAR_DEG
    assert abs(found.lag - late) < LAG_NEAR_S


@pytest.mark.slow
def test_a_late_image_clock_does_not_move_the_hand_eye(tmp_path: Path) -> None:
    assert_near(find_hand_eye(SMALL.record().stamped_late(0.08), tmp_path, "mcap"), late=0.08)


@pytest.fixture(scope="module", params=[0, 2026])
def recorded(request: pytest.FixtureRequest) -> Recorded:
    """40 stops; tf at 10 Hz, images between its stamps; errors of some 10 mm, noise of 3 mm."""
    return Drive(seed=request.param).record()


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["mcap", "ros1"])
@pytest.mark.parametrize("how", ["moving", "standing still", "late"])
def test_the_hand_eye_is_found_wherever_the_camera_is_and_whatever_its_clock(
    kind: str, how: str, recorded: Recorded, tmp_path: Path
) -> None:
    late = 0.08 if how == "late" else 0.0
    still = how == "standing still"
    drive = recorded.with_camera_fixed() if still else recorded.stamped_late(late)
    options = ("--eye-to-hand",) if still else ()
    assert_near(find_hand_eye(drive, tmp_path, kind, *options), late)
