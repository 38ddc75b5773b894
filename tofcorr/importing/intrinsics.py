"""Camera intrinsics as files and users give them, before the size of the images is known.

Files of many programs are read into the keys of `recording.yaml`: `_understood` finds the camera
where another program has put it, `_file_storage` reads OpenCV's own format.
"""

import re
import reprlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np

from tofcorr.data.recording import Header
from tofcorr.errors import CalibrationDataError, ConfigError
from tofcorr.geometry.camera import CameraIntrinsics, Matrix3
from tofcorr.importing.numbers import any_numbers
from tofcorr.options import is_shipped_name, one_line, parse_yaml, read_text, shipped_file

# Ours and recording.yaml; ROS camera_info; OpenCV's samples; iai_kinect2; MATLAB-style scripts.
_MATRIX_KEYS = ("K", "matrix", "camera_matrix", "cameraMatrix", "Camera_Matrix", "mtx")
_DISTORTION_KEYS = (
    *("distortion", "D", "distortion_coefficients", "distortionCoefficients"),
    *("Distortion_Coefficients", "distCoeffs", "dist_coeffs", "dist"),
)
_SIZE_KEYS = (("width", "height"), ("image_width", "image_height"), ("image_Width", "image_Height"))
_MODELS = ("plumb_bob", "rational_polynomial", "opencv", "none", "pinhole")


@dataclass(frozen=True, kw_only=True)
class GivenIntrinsics:
    """Pinhole matrix and distortion of a camera.

    Attributes:
        matrix: The 3x3 pinhole matrix, pixels, pixel centres at integer coordinates.
        distortion: OpenCV's coefficients k1 k2 p1 p2 [k3 ...]; empty for none.
        size: Width and height of the images that they are valid for; None if unknown.
        source: Where they come from (a file, options), for messages.
        matrix_by_size: For a camera with several image sizes the matrix of each; `matrix` is then
            that of the first.
    """

    matrix: Matrix3
    distortion: tuple[float, ...]
    source: str
    size: tuple[int, int] | None = None
    matrix_by_size: Mapping[tuple[int, int], Matrix3] = field(default_factory=dict)

    def camera(self, size: tuple[int, int]) -> CameraIntrinsics:
        """Return the intrinsics for images of `size`, width and height.

        Raises:
            CalibrationDataError: They are valid for another size, or no camera has them.
        """
        sizes = [*self.matrix_by_size] if self.size is None else [self.size]
        if sizes and size not in sizes:
            listed = ", ".join(f"{width}x{height}" for width, height in sizes)
            raise CalibrationDataError(
                f"{self.source}: the intrinsics hold for {listed} pixels, the images have "
                f"{size[0]}x{size[1]}."
            )
        camera = CameraIntrinsics(
            width=size[0],
            height=size[1],
            matrix=self.matrix_by_size.get(size, self.matrix),
            distortion=self.distortion,
        )
        described = {"camera": camera.section(), "depth_kind": "z"}
        Header.from_mapping(described, self.source, CalibrationDataError)
        if self.matrix[0][1] != 0:
            raise CalibrationDataError(
                f"{self.source}: the pinhole matrix has a skew of {self.matrix[0][1]:g}; OpenCV's "
                "board pose does not support it."
            )
        return camera


def intrinsics_from_numbers(
    focal_lengths: Sequence[float],
    centre: Sequence[float],
    distortion: Sequence[float],
    source: str,
) -> GivenIntrinsics:
    """Build intrinsics from fx, fy (one number for both, or two), cx, cy and the distortion."""
    matrix = _pinhole(focal_lengths[0], focal_lengths[-1], *centre)
    return GivenIntrinsics(matrix=matrix, distortion=tuple(distortion), source=source)


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
    values = _understood(values, source, camera)
    model = values.get("distortion_model")
    if isinstance(model, str) and model.lower() not in _MODELS:
        raise CalibrationDataError(
            f"{source}: distortion model '{one_line(model)}' is not supported; OpenCV's "
            "(plumb_bob, rational_polynomial) is needed. Undistort the images, or calibrate again."
        )
    distortion = _numbers(_first(values, _DISTORTION_KEYS, []), source, "the distortion")
    sides = [
        _numbers(values[key], source, "the image size")
        for keys in _SIZE_KEYS
        for key in keys
        if set(keys) <= values.keys()
    ]
    return GivenIntrinsics(
        matrix=_matrix(values, source),
        distortion=tuple(distortion),
        size=(int(sides[0][0]), int(sides[1][0])) if sides else None,
        source=source,
        matrix_by_size=values.get("matrix_by_size", {}),
    )


def _matrix(values: Mapping[str, Any], source: str) -> Matrix3:
    given = _first(values, _MATRIX_KEYS, None)
    if given is not None:
        numbers = _numbers(given, source, "the camera matrix")
    elif all(key in values for key in ("fx", "fy", "cx", "cy")):
        fx, fy, cx, cy = (_numbers([values[k]], source, k)[0] for k in ("fx", "fy", "cx", "cy"))
        numbers = [number for row in _pinhole(fx, fy, cx, cy) for number in row]
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
    a, b, c, d, e, f, g, h, i = numbers
    return (a, b, c), (d, e, f), (g, h, i)


def _pinhole(fx: float, fy: float, cx: float, cy: float) -> Matrix3:
    return (fx, 0.0, cx), (0.0, fy, cy), (0.0, 0.0, 1.0)


def _first(values: Mapping[str, Any], keys: Sequence[str], default: Any) -> Any:  # noqa: ANN401
    return next((values[key] for key in keys if values.get(key) is not None), default)


def _numbers(value: Any, source: str, what: str) -> list[float]:  # noqa: ANN401 - from a file
    """Flatten a list, a list of lists or a ROS matrix (rows, cols, data) of finite numbers."""
    if isinstance(value, Mapping):
        value = value.get("data", [])
    shown = one_line(reprlib.repr(value))
    try:
        array = np.asarray(value, dtype=np.float64).ravel()
    except (TypeError, ValueError, OverflowError):
        raise CalibrationDataError(f"{source}: {what} must be numbers, got {shown}.") from None
    if not np.isfinite(array).all() or np.asarray(value).dtype == bool:
        raise CalibrationDataError(f"{source}: {what} must be finite numbers, got {shown}.")
    return array.tolist()


def _read(path: Path) -> Mapping[str, Any]:
    try:
        text = read_text(path)
        words = text.replace(",", " ").split()
        if "opencv-matrix" in text or text.startswith("%YAML:") or text.lstrip().startswith("<"):
            values = _file_storage(text, str(path))
        elif len(words) == any_numbers(words).size == 9:
            values = {"K": words}
        else:
            values = parse_yaml(text, str(path))
    except ConfigError as error:
        raise CalibrationDataError(str(error)) from None
    if not isinstance(values, Mapping):
        raise CalibrationDataError(
            f"{path}: expected keys and values, got {type(values).__name__}."
        )
    return values


def _file_storage(text: str, source: str) -> Any:  # noqa: ANN401 - as YAML has it
    """Read a text of cv::FileStorage without OpenCV, whose parser ends the program on some texts.

    Returns:
        Keys and values of YAML, XML or JSON; a matrix as its `rows`, `cols` and `data`.

    Raises:
        CalibrationDataError: It is none of them, or a matrix has another number of entries than
            rows and columns.
    """
    try:
        if text.lstrip().startswith("<"):
            values = _xml(text)
        else:  # JSON is YAML too; OpenCV's first line and its tags are not.
            plain = re.sub(r"\A%YAML[: ][^\n]*|!!opencv-[a-z-]+", "", text)
            values = parse_yaml(plain, source)
    except (ConfigError, ElementTree.ParseError, ValueError) as error:
        reason = one_line(str(error).removeprefix(f"{source}: "))
        raise CalibrationDataError(f"{source}: not a readable OpenCV file ({reason}).") from None
    for key, value in values.items() if isinstance(values, Mapping) else ():
        if not isinstance(value, Mapping) or "data" not in value:
            continue
        count = len(value["data"]) if isinstance(value["data"], list) else "no list"
        rows, columns = (one_line(str(value.get(name))) for name in ("rows", "cols"))
        sides = any_numbers([rows, columns])
        if not sides.size or count != sides.prod():
            raise CalibrationDataError(
                f"{source}: '{key}' must have rows x cols numbers, got {count} for "
                f"{rows} x {columns}."
            )
    return values


def _xml(text: str) -> dict[str, Any]:
    """Return the elements of an XML text by their names: text, or what a matrix consists of."""
    if "<!" in text.replace("<!--", ""):
        raise ValueError("it declares entities or a document type, which OpenCV's files never do")
    found: dict[str, Any] = {}
    for element in ElementTree.fromstring(text):
        parts = {one.tag: (one.text or "").strip() for one in element}
        found[element.tag] = (element.text or "").strip().strip('"')
        if "data" in parts:
            found[element.tag] = parts | {"data": parts["data"].split()}
    return found


def _understood(values: Mapping[str, Any], source: str, camera: str | None) -> Mapping[str, Any]:
    """Return the keys and values of one camera in the names of `recording.yaml`.

    Raises:
        CalibrationDataError: There are several cameras, or the lens model is not supported.
    """
    for read in (_kalibr, _azure_kinect):
        found = read(values, source, camera)
        if found is not None:
            return found
    first = next(iter(values.values()), None)
    if isinstance(first, Mapping) and "cam_K" in first:
        return {"K": first["cam_K"]}  # The first image of BOP's scene_camera.json.
    return values["camera"] if isinstance(values.get("camera"), Mapping) else values


def _kalibr(values: Mapping[str, Any], source: str, camera: str | None) -> dict[str, Any] | None:
    """Read one camera of Kalibr's camchain: pinhole with radtan, which is OpenCV's model."""
    cameras = {
        name: entry
        for name, entry in values.items()
        if isinstance(entry, Mapping) and "camera_model" in entry and "intrinsics" in entry
    }
    if not cameras:
        return None
    if camera not in cameras and not (camera is None and len(cameras) == 1):
        listed = ", ".join(f"{name} ({one.get('rostopic', '?')})" for name, one in cameras.items())
        raise CalibrationDataError(
            f"{source}: it holds the cameras {one_line(listed)}. Name one: --intrinsics "
            f"'FILE#{one_line(str(next(iter(cameras))))}'."
        )
    entry = cameras[camera] if camera in cameras else next(iter(cameras.values()))
    models = str(entry["camera_model"]), str(entry.get("distortion_model", "none"))
    if models not in (("pinhole", "radtan"), ("pinhole", "none")):
        raise CalibrationDataError(
            f"{source}: Kalibr's model '{one_line(models[0])}', '{one_line(models[1])}' is not "
            "supported; calibrate with pinhole-radtan."
        )
    numbers = _numbers(entry["intrinsics"], source, "Kalibr's 'intrinsics'")
    if len(numbers) != 4:
        raise CalibrationDataError(
            f"{source}: Kalibr's 'intrinsics' must be fx, fy, cx, cy, got {len(numbers)} numbers."
        )
    found: dict[str, Any] = {}
    size = entry.get("resolution")
    if isinstance(size, list) and len(size) == 2:
        found = {"width": size[0], "height": size[1]}
    return found | {"K": _pinhole(*numbers), "distortion": entry.get("distortion_coeffs", [])}


def _azure_kinect(
    values: Mapping[str, Any], source: str, camera: str | None
) -> dict[str, Any] | None:
    """Read the depth camera of an Azure Kinect's calibration (`k4a_device_get_raw_calibration`).

    Its numbers are shares of the sensor of 1024 x 1024 pixels, counted from the pixel's corner.
    """
    information = values.get("CalibrationInformation")
    if not isinstance(information, Mapping):
        return None
    wanted = camera or "CALIBRATION_CameraPurposeDepth"
    cameras = information.get("Cameras")
    listed = cameras if isinstance(cameras, list) else []
    entry = next((c for c in listed if isinstance(c, Mapping) and c.get("Purpose") == wanted), {})
    lens = entry.get("Intrinsics")
    lens = lens if isinstance(lens, Mapping) else {}
    parameters = _numbers(lens.get("ModelParameters", []), source, "'ModelParameters'")
    if len(parameters) < 14:
        raise CalibrationDataError(
            f"{source}: no camera of purpose '{wanted}' with 14 'ModelParameters'."
        )
    model = str(lens.get("ModelType", "")).rpartition("_")[2]
    if model not in ("LensDistortionModelBrownConrady", "LensDistortionModelRational6KT"):
        raise CalibrationDataError(f"{source}: lens model '{one_line(model)}' is not supported.")
    cx, cy, fx, fy, k1, k2, k3, k4, k5, k6, _, _, p2, p1 = parameters[:14]
    # Of each size of images the pixels that the sensor is binned to, and what is cut off left and
    # above. From the Azure-Kinect-Sensor-SDK, mode_specific_calibration.c.
    modes = {
        (640, 576): (1024, 192, 180),
        (320, 288): (512, 96, 90),
        (1024, 1024): (1024, 0, 0),
        (512, 512): (512, 0, 0),
    }
    by_size = {
        size: _pinhole(fx * side, fy * side, cx * side - left - 0.5, cy * side - top - 0.5)
        for size, (side, left, top) in modes.items()
    }
    distortion = [k1, k2, p1, p2, k3, k4, k5, k6]
    return {"K": by_size[640, 576], "distortion": distortion, "matrix_by_size": by_size}
