"""Reading camera intrinsics from the files that other programs write."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from tofcorr.errors import CalibrationDataError, ConfigError
from tofcorr.importing.file_storage import is_file_storage, read_file_storage
from tofcorr.importing.given_intrinsics import GivenIntrinsics, intrinsics_from_numbers
from tofcorr.importing.intrinsics_formats import numbers_in, understood
from tofcorr.options import is_shipped_name, shipped_file
from tofcorr.options.messages import one_line
from tofcorr.options.yaml_files import parse_yaml, read_text

# Ours and recording.yaml; ROS camera_info; OpenCV's samples; iai_kinect2; MATLAB-style scripts.
_MATRIX_KEYS = ("K", "matrix", "camera_matrix", "cameraMatrix", "Camera_Matrix", "mtx")
_DISTORTION_KEYS = (
    *("distortion", "D", "distortion_coefficients", "distortionCoefficients"),
    *("Distortion_Coefficients", "distCoeffs", "dist_coeffs", "dist"),
)
_SIZE_KEYS = (("width", "height"), ("image_width", "image_height"), ("image_Width", "image_Height"))
_MODELS = ("plumb_bob", "rational_polynomial", "opencv", "none", "pinhole")


def read_named_intrinsics(text: str) -> GivenIntrinsics:
    """Read the intrinsics that a user names.

    Args:
        text: A file, a file and one of its cameras (`camchain.yaml#cam1`), or a shipped name.

    Raises:
        CalibrationDataError: As `read_intrinsics`.
        ConfigError: There is no such file, and no such name.
    """
    file, mark, camera = text.rpartition("#")
    if mark and not Path(text).exists():
        return intrinsics_from_mapping(_read(Path(file)), text, camera)
    given = read_intrinsics(shipped_file(text, "import"))
    # A name means the same on every computer; the path of the installed package does not.
    return replace(given, source=text) if is_shipped_name(text, "import") else given


def read_intrinsics(path: Path) -> GivenIntrinsics:
    """Read a camera's pinhole matrix and distortion.

    It reads YAML and JSON with `K` (or `camera_matrix`, or fx, fy, cx, cy) and `distortion`
    (or `distortion_coefficients`), at the top or under `camera`, ROS's camera_info files, OpenCV's
    FileStorage in YAML, XML and JSON, Kalibr's camchain (radtan), an Azure Kinect's raw
    calibration, BOP's scene_camera.json, and text with the nine numbers of a matrix, which states
    no distortion.

    Raises:
        CalibrationDataError: The file cannot be read, has no matrix, or has another distortion
            model.
    """
    return intrinsics_from_mapping(_read(path), str(path))


def intrinsics_from_mapping(
    values: Mapping[str, Any], source: str, camera: str | None = None
) -> GivenIntrinsics:
    """Read a camera's pinhole matrix and distortion from keys and values.

    Args:
        values: As in one of the files that `read_intrinsics` reads.
        source: Where they come from, for messages.
        camera: Which of several cameras; None: the only one.

    Raises:
        CalibrationDataError: There is no matrix, or another distortion model.
    """
    values = understood(values, source, camera)
    model = values.get("distortion_model")
    if isinstance(model, str) and model.lower() not in _MODELS:
        raise CalibrationDataError(
            f"{source}: distortion model '{one_line(model)}' is not supported; OpenCV's "
            "(plumb_bob, rational_polynomial) is needed. Undistort the images, or calibrate again."
        )
    distortion = numbers_in(_first(values, _DISTORTION_KEYS, []), source, "the distortion")
    matrix = _matrix(values, source)
    if abs(matrix[1, 0]) + abs(matrix[2, 0]) + abs(matrix[2, 1]) > 0 or matrix[2, 2] != 1:
        raise CalibrationDataError(
            f"{source}: the camera matrix must be upper triangular with a last row of 0 0 1, "
            f"got {matrix.tolist()}."
        )
    rows = [tuple(row) for row in matrix.tolist()]
    return GivenIntrinsics(
        matrix=(rows[0], rows[1], rows[2]),
        distortion=tuple(distortion),
        size=_size(values, source),
        source=source,
        matrix_by_size=values.get("matrix_by_size", {}),
    )


def _matrix(values: Mapping[str, Any], source: str) -> np.ndarray:
    given = _first(values, _MATRIX_KEYS, None)
    if given is not None:
        numbers = numbers_in(given, source, "the camera matrix")
    elif all(key in values for key in ("fx", "fy", "cx", "cy")):
        fx, fy, cx, cy = (numbers_in([values[k]], source, k)[0] for k in ("fx", "fy", "cx", "cy"))
        given = intrinsics_from_numbers((fx, fy), (cx, cy), (), source)
        numbers = [number for row in given.matrix for number in row]
    else:
        keys = one_line(", ".join(f"'{key}'" for key in list(values)[:8]))
        raise CalibrationDataError(
            f"{source}: no camera matrix; expected 'K' (3x3) or fx, fy, cx, cy, got "
            f"{keys or 'none'}."
        )
    if len(numbers) != 9:
        raise CalibrationDataError(
            f"{source}: the camera matrix must have 9 numbers, got {len(numbers)}."
        )
    return np.array(numbers).reshape(3, 3)


def _size(values: Mapping[str, Any], source: str) -> tuple[int, int] | None:
    for width, height in _SIZE_KEYS:
        if width in values and height in values:
            numbers = numbers_in([values[width], values[height]], source, "the image size")
            return int(numbers[0]), int(numbers[1])
    return None


def _first(values: Mapping[str, Any], keys: Sequence[str], default: Any) -> Any:  # noqa: ANN401
    return next((values[key] for key in keys if values.get(key) is not None), default)


def _plain_matrix(text: str) -> list[float] | None:
    """Return the nine numbers of a file that holds a 3x3 matrix alone, as `numpy.savetxt` writes.

    None for any other file.
    """
    words = text.replace(",", " ").split()
    if len(words) != 9:
        return None
    try:
        return [float(word) for word in words]
    except ValueError:
        return None


def _read(path: Path) -> Mapping[str, Any]:
    try:
        text = read_text(path)
        if is_file_storage(text):
            return read_file_storage(text, str(path))
        if (plain := _plain_matrix(text)) is not None:
            return {"K": plain}
        values = parse_yaml(text, str(path))
    except ConfigError as error:
        raise CalibrationDataError(str(error)) from None
    if not isinstance(values, Mapping):
        raise CalibrationDataError(
            f"{path}: expected keys and values, got {type(values).__name__}."
        )
    return values
