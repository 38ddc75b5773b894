"""Intrinsics are read from the files that other programs write."""

from contextlib import suppress
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from importing.intrinsics_texts import DISTORTION, JSON, NUMBERS, OPENCV, OURS, RECORDING, ROS, K

from tofcorr.errors import CalibrationDataError, TofcorrError
from tofcorr.importing.intrinsics import read_intrinsics, read_named_intrinsics


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


@pytest.mark.parametrize("delimiter", [" ", ","])
def test_a_matrix_alone_is_understood(tmp_path: Path, delimiter: str) -> None:
    # The K.txt beside the frames of many simulators and data sets.
    np.savetxt(tmp_path / "K.txt", np.array(K), delimiter=delimiter)
    lens = read_intrinsics(tmp_path / "K.txt")
    assert lens.matrix == tuple(map(tuple, K))
    assert lens.distortion == ()


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
        ("K: [[1, 0, 0], [2, 1, 0], [0, 0, 1]]", "upper triangular"),
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


def test_shipped_intrinsics_are_called_by_their_name_and_not_by_where_they_are_installed() -> None:
    given = read_named_intrinsics("kinect2")
    assert given.source == "kinect2"
    assert given.size == (512, 424)
