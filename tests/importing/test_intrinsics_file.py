"""Intrinsics are read from the files that other programs write."""

import json
from contextlib import suppress
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from tofcorr.errors import CalibrationDataError, TofcorrError
from tofcorr.importing.intrinsics_file import read_intrinsics, read_named_intrinsics

K = [[365.5, 0.0, 255.5], [0.0, 366.5, 205.0], [0.0, 0.0, 1.0]]
DISTORTION = [0.09, -0.27, 0.0, 0.001, 0.095]

OURS = f"width: 512\nheight: 424\nK: {K}\ndistortion: {DISTORTION}\n"
RECORDING = f"camera: {{width: 512, height: 424, K: {K}, distortion: {DISTORTION}}}\n"
ROS = f"""
image_width: 512
image_height: 424
camera_matrix: {{rows: 3, cols: 3, data: {np.ravel(K).tolist()}}}
distortion_model: plumb_bob
distortion_coefficients: {{rows: 1, cols: 5, data: {DISTORTION}}}
"""
JSON = json.dumps({"width": 512, "height": 424, "camera_matrix": K, "dist_coeffs": [DISTORTION]})
OPENCV = f"""%YAML:1.0
---
cameraMatrix: !!opencv-matrix
   rows: 3
   cols: 3
   dt: d
   data: {np.ravel(K).tolist()}
"""
NUMBERS = f"{{fx: 365.5, fy: 366.5, cx: 255.5, cy: 205, distortion: {DISTORTION}}}"


@pytest.mark.parametrize(
    ("text", "size"),
    [(OURS, (512, 424)), (RECORDING, (512, 424)), (ROS, (512, 424)), (JSON, (512, 424)),
     (NUMBERS, None)],
    ids=["own", "recording", "ros", "json", "numbers"],
)  # fmt: skip
def test_every_way_to_write_a_camera_is_understood(
    tmp_path: Path, text: str, size: tuple[int, int] | None
) -> None:
    path = tmp_path / "camera.yaml"
    path.write_text(text)
    lens = read_intrinsics(path)
    assert lens.matrix == tuple(map(tuple, K))
    assert lens.distortion == tuple(DISTORTION)
    assert lens.size == size


@pytest.mark.parametrize("suffix", ["yaml", "xml", "json"])
def test_files_of_opencv_are_understood(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"calib.{suffix}"
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    storage.write("image_width", 512)
    storage.write("image_height", 424)
    storage.write("cameraMatrix", np.array(K))
    storage.write("distortionCoefficients", np.array([DISTORTION]))
    storage.release()
    lens = read_intrinsics(path)
    assert lens.matrix == tuple(map(tuple, K))
    assert lens.distortion == tuple(DISTORTION)
    assert lens.size == (512, 424)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("distortion: [0, 0, 0, 0]", r"no camera matrix.*got 'distortion'"),
        ("K: [1, 2, 3]", "must have 9 numbers, got 3"),
        ("K: [[a, 0, 0], [0, 1, 0], [0, 0, 1]]", "camera matrix must be numbers"),
        ("K: [[.nan, 0, 0], [0, 1, 0], [0, 0, 1]]", "camera matrix must be finite"),
        ("K: [[1, 0, 0], [2, 1, 0], [0, 0, 1]]", "upper triangular"),
        (ROS.replace("plumb_bob", "equidistant"), "'equidistant' is not supported"),
        ("just text", "expected keys and values, got str"),
        ("K: [[1, 0", "not valid YAML"),
        ("%YAML:1.0\n---\nK: !!opencv-matrix\n   rows: 3\n   cols: [", "not a readable OpenCV"),
    ],
)
def test_broken_files_are_refused_by_name(tmp_path: Path, text: str, message: str) -> None:
    path = tmp_path / "camera.yaml"
    path.write_text(text)
    with pytest.raises(CalibrationDataError, match=message) as refusal:
        read_intrinsics(path)
    assert "camera.yaml" in str(refusal.value)


def test_a_missing_file_is_refused(tmp_path: Path) -> None:
    with pytest.raises(CalibrationDataError, match="there is no such file"):
        read_intrinsics(tmp_path / "none.yaml")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("%YAML:1.0\n---\n- 1\n", "expected keys and values, got list"),
        ("%YAML:1.0\n---\nK: !!opencv-matrix\n   rows: 3\n   cols: 3\n   data: [1, 2]\n",
         "'K' must have rows x cols numbers, got 2 for 3 x 3"),
        ("%YAML:1.0\n---\nK: !!opencv-matrix\n   data: [1, 2]\n", "got 2 for None x None"),
        ("<opencv_storage><K><data>1", "not a readable OpenCV file"),
        ('<!DOCTYPE a [<!ENTITY b "c">]><opencv_storage>&b;</opencv_storage>', "entities"),
        ("<opencv_storage><size>3</size></opencv_storage>", "no camera matrix.*got 'size'"),
    ],
)  # fmt: skip
def test_broken_files_of_opencv_are_refused_without_opencv(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, text: str, message: str
) -> None:
    # cv2.FileStorage once ended the process on a mutated file.
    monkeypatch.delattr(cv2, "FileStorage")
    path = tmp_path / "camera.xml"
    path.write_text(text)
    with pytest.raises(CalibrationDataError, match=message):
        read_intrinsics(path)


def test_a_file_that_is_too_large_is_refused_unread(tmp_path: Path) -> None:
    path = tmp_path / "camera.yaml"
    path.write_text("%YAML:1.0\n---\n")
    with path.open("r+b") as file:
        file.truncate(17_000_000)
    with pytest.raises(CalibrationDataError, match="larger than 16 MB"):
        read_intrinsics(path)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (OURS, "hold for 512x424 pixels, the images have 320x240"),
        ("K: [[-1, 0, 0], [0, 1, 0], [0, 0, 1]]", "focal lengths of K must be positive"),
        ("K: [[9, 1, 0], [0, 9, 0], [0, 0, 1]]", "skew of 1"),
        ("{fx: 9, fy: 9, cx: 1, cy: 1, D: [1, 2, 3]}", "0, 4, 5, 8, 12 or 14 coefficients"),
    ],
)
def test_a_lens_that_does_not_fit_the_images_is_refused(
    tmp_path: Path, text: str, message: str
) -> None:
    path = tmp_path / "camera.yaml"
    path.write_text(text)
    with pytest.raises(CalibrationDataError, match=message) as refusal:
        read_intrinsics(path).camera((320, 240))
    assert "camera.yaml" in str(refusal.value)


@settings(
    max_examples=150, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(
    original=st.sampled_from([OURS, RECORDING, ROS, JSON, OPENCV]),
    start=st.integers(0, 200),
    length=st.integers(0, 40),
    junk=st.text(alphabet="0:{}[]-!&*'\"\n K,.ae", max_size=12),
)
def test_a_damaged_file_is_read_or_refused_but_never_crashes(
    tmp_path: Path, original: str, start: int, length: int, junk: str
) -> None:
    path = tmp_path / "camera.yaml"
    path.write_text(original[:start] + junk + original[start + length :])
    with suppress(TofcorrError):
        read_intrinsics(path).camera((512, 424))


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
    lens = {
        "ModelParameters": numbers,
        "ModelType": "CALIBRATION_LensDistortionModelBrownConrady",
    }
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
    tmp_path: Path,
    size: tuple[int, int],
    focal: tuple[float, float],
    centre: tuple[float, float],
) -> None:
    path = write_text(tmp_path, json.dumps(azure_kinect()), "k4a.json")
    camera = read_intrinsics(path).camera(size)
    np.testing.assert_allclose(np.diag(camera.matrix)[:2], focal)
    np.testing.assert_allclose(np.array(camera.matrix)[:2, 2], centre)
    # OpenCV's order: k1 k2 p1 p2 k3 k4 k5 k6.
    np.testing.assert_allclose(camera.distortion, [0.1, 0.2, 1e-4, 2e-4, 0.3, 0.4, 0.5, 0.6])


def test_an_azure_kinect_has_no_other_sizes(tmp_path: Path) -> None:
    path = write_text(tmp_path, json.dumps(azure_kinect()), "k4a.json")
    with pytest.raises(CalibrationDataError, match=r"640x576.*these have 512x424"):
        read_intrinsics(path).camera((512, 424))


def test_the_matrix_of_a_bop_scene_is_read(tmp_path: Path) -> None:
    scene = {"3": {"cam_K": np.ravel(K).tolist(), "depth_scale": 0.1}}
    path = write_text(tmp_path, json.dumps(scene), "scene_camera.json")
    assert read_intrinsics(path).matrix == tuple(map(tuple, K))


def test_shipped_intrinsics_are_called_by_their_name_and_not_by_where_they_are_installed() -> None:
    given = read_named_intrinsics("kinect2")
    assert given.source == "kinect2"
    assert given.size == (512, 424)
