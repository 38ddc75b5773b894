"""Intrinsics as Kalibr, ROS, the Azure Kinect and BOP write them."""

import json
from pathlib import Path

import numpy as np
import pytest
from importing.intrinsics_texts import DISTORTION, ROS, K

from tofcorr.errors import CalibrationDataError
from tofcorr.importing.intrinsics import read_intrinsics, read_named_intrinsics

KALIBR = """
cam0:
  camera_model: pinhole
  intrinsics: [365.5, 366.5, 255.5, 205.0]
  distortion_model: radtan
  distortion_coeffs: [0.09, -0.27, 0.001, 0.002]
  resolution: [512, 424]
  rostopic: /tof/ir
"""


def write_text(folder: Path, text: str, name: str = "camera.yaml") -> Path:
    path = folder / name
    path.write_text(text, encoding="utf-8")
    return path


def test_kalibr_s_radtan_is_opencv_s_model(tmp_path: Path) -> None:
    lens = read_intrinsics(write_text(tmp_path, KALIBR))
    assert lens.matrix == tuple(map(tuple, K))
    assert lens.distortion == (0.09, -0.27, 0.001, 0.002)
    assert lens.size == (512, 424)


@pytest.mark.parametrize(
    ("before", "after", "said"),
    [("radtan", "equidistant", "'equidistant' is not supported"), ("pinhole", "omni", "'omni'")],
)
def test_other_lenses_of_kalibr_are_refused_by_name(
    tmp_path: Path, before: str, after: str, said: str
) -> None:
    path = write_text(tmp_path, KALIBR.replace(f": {before}", f": {after}"))
    with pytest.raises(CalibrationDataError, match=said):
        read_intrinsics(path)


def test_of_several_cameras_one_is_named_behind_the_file(tmp_path: Path) -> None:
    second = KALIBR.replace("cam0", "cam1").replace("365.5", "400.0")
    path = write_text(tmp_path, KALIBR + second)
    with pytest.raises(CalibrationDataError, match=r"cam0 .*cam1 .*FILE#cam0"):
        read_named_intrinsics(str(path))
    assert read_named_intrinsics(f"{path}#cam1").matrix[0][0] == 400.0


@pytest.mark.parametrize("model", ["equidistant", "fisheye", "thin_prism"])
def test_fisheye_lenses_of_ros_are_refused_by_name(tmp_path: Path, model: str) -> None:
    with pytest.raises(CalibrationDataError, match=f"distortion model '{model}'"):
        read_intrinsics(write_text(tmp_path, ROS.replace("plumb_bob", model)))


def test_a_rational_lens_of_ros_keeps_its_eight_numbers(tmp_path: Path) -> None:
    eight = [0.1, 0.2, 0.001, 0.002, 0.3, 0.4, 0.5, 0.6]
    text = ROS.replace("plumb_bob", "rational_polynomial").replace(str(DISTORTION), str(eight))
    assert read_intrinsics(write_text(tmp_path, text)).distortion == tuple(eight)


def azure_kinect() -> dict[str, object]:
    """A raw calibration: cx cy fx fy k1 ... k6 codx cody p2 p1, shares of 1024 pixels."""
    numbers = [0.5, 0.52, 0.4925, 0.4930, *(0.1 * k for k in range(1, 7)), 0, 0, 2e-4, 1e-4]
    lens = {"ModelParameters": numbers, "ModelType": "CALIBRATION_LensDistortionModelBrownConrady"}
    camera = {"Purpose": "CALIBRATION_CameraPurposeDepth", "Intrinsics": lens}
    colour = {"Purpose": "CALIBRATION_CameraPurposePhotoVideo", "Intrinsics": {}}
    return {"CalibrationInformation": {"Cameras": [colour, camera]}}


@pytest.mark.parametrize(
    ("size", "focal", "centre"),
    [
        # 1024 f; 1024 c - crop - 0.5: pixel centres count, not corners.
        ((640, 576), (504.32, 504.832), (319.5, 351.98)),
        ((1024, 1024), (504.32, 504.832), (511.5, 531.98)),
        ((320, 288), (252.16, 252.416), (159.5, 175.74)),
        ((512, 512), (252.16, 252.416), (255.5, 265.74)),
    ],
)
def test_an_azure_kinect_s_calibration_holds_for_all_its_modes(
    tmp_path: Path, size: tuple[int, int], focal: tuple[float, float], centre: tuple[float, float]
) -> None:
    path = write_text(tmp_path, json.dumps(azure_kinect()), "k4a.json")
    camera = read_intrinsics(path).camera(size)
    np.testing.assert_allclose(np.diag(camera.matrix)[:2], focal)
    np.testing.assert_allclose(np.array(camera.matrix)[:2, 2], centre)
    # OpenCV's order: k1 k2 p1 p2 k3 k4 k5 k6.
    np.testing.assert_allclose(camera.distortion, [0.1, 0.2, 1e-4, 2e-4, 0.3, 0.4, 0.5, 0.6])


def test_an_azure_kinect_has_no_other_sizes(tmp_path: Path) -> None:
    path = write_text(tmp_path, json.dumps(azure_kinect()), "k4a.json")
    with pytest.raises(CalibrationDataError, match=r"640x576.*the images have 512x424"):
        read_intrinsics(path).camera((512, 424))


def test_the_matrix_of_a_bop_scene_is_read(tmp_path: Path) -> None:
    scene = {"3": {"cam_K": np.ravel(K).tolist(), "depth_scale": 0.1}}
    path = write_text(tmp_path, json.dumps(scene), "scene_camera.json")
    assert read_intrinsics(path).matrix == tuple(map(tuple, K))
