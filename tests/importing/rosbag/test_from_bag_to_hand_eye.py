"""From a bag to the hand-eye transform: no board, no guess, nothing but depth, infrared and tf."""

from pathlib import Path

import numpy as np
import pytest
from importing.posed_scene import Drive, Recorded, apart
from importing.rosbag import written_bags as bags
from importing.rosbag.test_import_rosbag import WITH_INFRARED, import_bag

import tofcorr

NEAR_MM, NEAR_DEG = 1.0, 0.1
"""What is asked of the whole way: a hand-eye transform within 1 mm and 0.1 degrees."""


@pytest.fixture(scope="module")
def recorded() -> Recorded:
    """40 stops; tf at 10 Hz, images between its stamps; errors of some 10 mm, noise of 3 mm."""
    return Drive().record()


def assert_hand_eye_is_found(recorded: Recorded, folder: Path, kind: str, *options: object) -> None:
    path = bags.write_drive(recorded, folder, kind)
    imported = import_bag(path, folder / "recording", *WITH_INFRARED, *options)
    assert imported.exit_code == 0, imported.text
    trained = tofcorr.train(folder / "recording", config="ea")
    transform = np.array(trained.report["hand_eye"]["tool_from_camera"])
    mm, degrees = apart(transform, recorded.tool_from_camera)
    assert mm < NEAR_MM
    assert degrees < NEAR_DEG


def test_a_late_image_clock_does_not_move_the_hand_eye(recorded: Recorded, tmp_path: Path) -> None:
    assert_hand_eye_is_found(recorded.stamped_late(0.08), tmp_path, "mcap")


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["mcap", "ros1"])
def test_the_hand_eye_of_a_moving_camera_is_found(
    kind: str, recorded: Recorded, tmp_path: Path
) -> None:
    assert_hand_eye_is_found(recorded, tmp_path, kind)


@pytest.mark.slow
def test_the_pose_of_a_camera_that_stands_still_is_found(
    recorded: Recorded, tmp_path: Path
) -> None:
    assert_hand_eye_is_found(recorded.with_camera_fixed(), tmp_path, "mcap", "--eye-to-hand")
