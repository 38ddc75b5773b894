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
from tofcorr.importing.intrinsics_file import read_intrinsics

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
    with pytest.raises(CalibrationDataError, match="cannot be read"):
        read_intrinsics(tmp_path / "none.yaml")


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
    original=st.sampled_from([OURS, RECORDING, ROS, JSON]),
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
