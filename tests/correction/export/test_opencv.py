"""OpenCV reads intrinsics, pose and coefficients of an exported calibration."""

from pathlib import Path
from typing import Any

import cv2  # noqa: TID251 - the independent reader
import numpy as np
import pytest
import torch
from correction.export.states import ACCURACY, EYE_TO_HAND, TRANSFORMS, calibration, write
from small_recordings import CAMERA

from tofcorr.error_terms.base import Domain, Interval
from tofcorr.geometry.camera import CameraIntrinsics


@pytest.fixture
def opened(tmp_path: Path) -> Any:
    def read(**changed: Any) -> Any:
        write("opencv", calibration(TRANSFORMS["general"], **changed), tmp_path / "camera.yml")
        storage = cv2.FileStorage(str(tmp_path / "camera.yml"), cv2.FILE_STORAGE_READ)
        assert storage.isOpened()
        return storage

    return read


def coefficients(storage: Any) -> dict[tuple[str, str], Any]:
    """Return the nodes by group and symbol; they live as long as the storage."""
    nodes = storage.getNode("coefficients")
    read = [nodes.at(k) for k in range(nodes.size())]
    return {(n.getNode("group").string(), n.getNode("symbol").string()): n for n in read}


def test_opencv_reads_camera_and_pose_to_the_last_digit(opened: Any) -> None:
    state, storage = calibration(TRANSFORMS["general"]), opened()
    assert storage.getNode("image_width").real() == 7
    np.testing.assert_array_equal(storage.getNode("camera_matrix").mat(), state.camera.matrix)
    distortion = storage.getNode("distortion_coefficients").mat()
    np.testing.assert_array_equal(distortion, [state.camera.distortion])
    transform = storage.getNode("tool_from_camera").mat()
    np.testing.assert_array_equal(transform, state.tool_from_camera.numpy())
    assert storage.getNode("parent_frame").string() == "tool0"
    errors = storage.getNode("translation_standard_errors_mm").mat()
    np.testing.assert_array_equal(errors, [ACCURACY.translation_se_mm])
    assert storage.getNode("depth_kind").string() == "z"


def test_the_coefficients_read_are_those_of_the_papers_formula(opened: Any) -> None:
    storage = opened()
    c = coefficients(storage)
    paper = calibration(np.eye(4)).model().error.paper_coefficients()
    expected = {(group, name): one for group, all_ in paper.items() for name, one in all_.items()}
    assert {key: node.getNode("value").real() for key, node in c.items()} == expected
    assert c["distance", "c2"].getNode("unit").string() == "m/m^2"
    assert c["pixel", "r0"].getNode("unit").string() == "pixel"
    assert c["intensity", "i1"].getNode("unit").string() == "m/amplitude"


def test_a_still_camera_is_said_to_be_one_and_one_without_a_robot_has_no_pose(opened: Any) -> None:
    storage = opened(frames=EYE_TO_HAND)
    assert storage.getNode("eye_to_hand").real() == 1
    assert storage.getNode("parent_frame").string() == "base_link"
    storage = opened(hand_eye_estimated=False)
    assert storage.getNode("hand_eye_estimated").real() == 0
    assert storage.getNode("tool_from_camera").empty()
    assert not storage.getNode("camera_matrix").empty()


def test_a_vertex_that_is_nowhere_is_nan_and_quotes_survive(opened: Any) -> None:
    storage = opened(coefficients=torch.zeros(10, dtype=torch.float64), name='E"A\\')
    assert np.isnan(coefficients(storage)["pixel", "r0"].getNode("value").real())
    assert storage.getNode("model").string() == 'E"A\\'


def test_the_map_of_a_whole_sensor_is_read_by_opencv(opened: Any) -> None:
    height, width = 480, 640
    pattern = torch.randn(height, width, generator=torch.Generator().manual_seed(0)).double()
    storage = opened(
        terms=[{"kind": "fixed_pattern"}],
        camera=CameraIntrinsics(width=width, height=height, matrix=CAMERA.matrix),
        domain=Domain(height=height, width=width, radial_distance=Interval(0.5, 3.0)),
        fixed_pattern=pattern,
    )
    np.testing.assert_array_equal(storage.getNode("fixed_pattern_m").mat(), pattern.numpy())
    # A lens without distortion is one of zero coefficients.
    assert not storage.getNode("distortion_coefficients").mat().any()
