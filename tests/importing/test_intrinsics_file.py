"""Intrinsics are read from the files that other programs write."""

import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from tofcorr.errors import CalibrationDataError
from tofcorr.importing.intrinsics import read_intrinsics, read_named_intrinsics

K = [[365.5, 0.0, 255.5], [0.0, 366.5, 205.0], [0.0, 0.0, 1.0]]
DISTORTION = [0.09, -0.27, 0.001, 0.002]
EIGHT = [0.1, 0.2, 0.001, 0.002, 0.3, 0.4, 0.5, 0.6]
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
NUMBERS = f"{{fx: 365.5, fy: 366.5, cx: 255.5, cy: 205, distortion: {DISTORTION}}}"
KALIBR = f"""
cam0:
  camera_model: pinhole
  intrinsics: [365.5, 366.5, 255.5, 205.0]
  distortion_model: radtan
  distortion_coeffs: {DISTORTION}
  resolution: [512, 424]
  rostopic: /tof/ir
"""


def written(folder: Path, text: str) -> Path:
    path = folder / "camera.yaml"
    path.write_text(text, encoding="utf-8")
    return path


@pytest.mark.parametrize(
    ("text", "distortion", "size"),
    [
        *((text, DISTORTION, (512, 424)) for text in (OURS, RECORDING, ROS, JSON, KALIBR)),
        (NUMBERS, DISTORTION, None),
        (ROS.replace("plumb_bob", "rational_polynomial").replace(str(DISTORTION), str(EIGHT)),
         EIGHT, (512, 424)),
        # The K.txt beside the frames of many simulators and data sets.
        *((between.join(map(str, np.ravel(K))), [], None) for between in (" ", ",")),
    ],
)  # fmt: skip
def test_every_way_to_write_a_camera_is_understood(
    tmp_path: Path, text: str, distortion: list[float], size: tuple[int, int] | None
) -> None:
    lens = read_intrinsics(written(tmp_path, text))
    assert lens.matrix == tuple(map(tuple, K))
    assert lens.distortion == tuple(distortion)
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


# cv2.FileStorage once ended the process on a mutated file: the texts of OpenCV are read without it.
@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("distortion: [0, 0, 0, 0]", r"no camera matrix.*got 'distortion'"),
        ("K: [1, 2, 3]", "camera matrix: expected 9 finite numbers"),
        ("K: [[a, 0, 0], [0, 1, 0], [0, 0, 1]]", "expected 9 finite numbers, got .*'a'"),
        ("K: [[.nan, 0, 0], [0, 1, 0], [0, 0, 1]]", "expected 9 finite numbers, got .*nan"),
        *((ROS.replace("plumb_bob", model), f"'{model}' is not supported")
          for model in ("equidistant", "fisheye", "thin_prism")),
        (KALIBR.replace(": radtan", ": equidistant"), "'equidistant' is not supported"),
        (KALIBR.replace(": pinhole", ": omni"), "'omni'"),
        ("just text", "expected keys, got str"),
        ("K: [[1, 0", "not valid YAML"),
        ("%YAML:1.0\n---\nK: !!opencv-matrix\n   rows: 3\n   cols: [", "not valid YAML"),
        ("%YAML:1.0\n---\n- 1\n", "expected keys, got list"),
        ("%YAML:1.0\n---\nK: !!opencv-matrix\n   rows: 3\n   cols: 3\n   data: [1, 2]\n",
         "camera matrix: expected 9 finite numbers"),
        ("<opencv_storage><K><data>1", "not a readable OpenCV file"),
        ('<!DOCTYPE a [<!ENTITY b "c">]><opencv_storage>&b;</opencv_storage>', "entities"),
        ("<opencv_storage><size>3</size></opencv_storage>", "no camera matrix.*got 'size'"),
        pytest.param("%YAML:1.0\n---\n" + 17_000_000 * " ", "larger than 16 MB", id="large"),
        (OURS, "hold for 512x424 pixels, images have 320x240"),
        ("K: [[-1, 0, 0], [0, 1, 0], [0, 0, 1]]", "focal lengths of K must be 0.001"),
        ("K: [[9, 1, 0], [0, 9, 0], [0, 0, 1]]", "skew of 1"),
        ("K: [[1, 0, 0], [2, 1, 0], [0, 0, 1]]", "upper triangular"),
        ("{fx: 9, fy: 9, cx: 1, cy: 1, D: [1, 2, 3]}", "0, 4, 5, 8, 12 or 14 coefficients"),
    ],
)  # fmt: skip
def test_broken_files_and_lenses_that_do_not_fit_are_refused_by_name(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, text: str, message: str
) -> None:
    monkeypatch.delattr(cv2, "FileStorage")
    with pytest.raises(CalibrationDataError, match=message) as refusal:
        read_intrinsics(written(tmp_path, text)).camera((320, 240))
    assert "camera.yaml" in str(refusal.value)


def test_a_camera_is_named_behind_the_file_and_a_shipped_one_by_its_name(tmp_path: Path) -> None:
    with pytest.raises(CalibrationDataError, match="there is no such file"):
        read_intrinsics(tmp_path / "none.yaml")
    assert read_named_intrinsics("kinect2").source == "kinect2"
    second = KALIBR.replace("cam0", "cam1").replace("365.5", "400.0")
    path = written(tmp_path, KALIBR + second)
    with pytest.raises(CalibrationDataError, match=r"cam0 .*cam1 .*FILE#cam0"):
        read_named_intrinsics(str(path))
    assert read_named_intrinsics(f"{path}#cam1").matrix[0][0] == 400.0
