"""Camera intrinsics as files and users give them, before the size of the images is known.

Files of many programs are read into the keys of `recording.yaml`: `_kalibr` finds the camera where
Kalibr has put it, `_file_storage` reads OpenCV's own format.
"""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

from tofcorr.data.recording import Header
from tofcorr.errors import CalibrationDataError
from tofcorr.geometry.camera import CameraIntrinsics, Matrix3
from tofcorr.importing.numbers import any_numbers, finite_numbers
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
    """

    matrix: Matrix3
    distortion: tuple[float, ...]
    source: str
    size: tuple[int, int] | None = None

    def camera(self, size: tuple[int, int]) -> CameraIntrinsics:
        """Return the intrinsics for images of `size`, width and height.

        Raises:
            CalibrationDataError: They are valid for another size, or no camera has them.
        """
        own, (width, height) = self.size or size, size
        if own != size:
            advice = " Are they turned? Add --rotate 90 or --rotate 270 (import frames, rosbag)."
            said = f"the intrinsics hold for {own[0]}x{own[1]} pixels, images have {width}x{height}"
            raise CalibrationDataError(f"{self.source}: {said}.{advice * (own == (height, width))}")
        camera = CameraIntrinsics(
            width=width, height=height, matrix=self.matrix, distortion=self.distortion
        )
        described = {"camera": camera.section(), "depth_kind": "z"}
        Header.from_mapping(described, self.source, CalibrationDataError)
        if self.matrix[0][1] != 0:
            raise CalibrationDataError(f"{self.source}: K has a skew of {self.matrix[0][1]:g}.")
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
    FileStorage in YAML, XML and JSON, Kalibr's camchain (radtan), and text with the nine numbers of
    a matrix, which states no distortion.

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
    found = _kalibr(values, source, camera)
    below = values.get("camera")
    values = found or (below if isinstance(below, Mapping) else values)
    model = values.get("distortion_model")
    if isinstance(model, str) and model.lower() not in _MODELS:
        known = "expected OpenCV's plumb_bob or rational_polynomial"
        raise CalibrationDataError(f"{source}: '{one_line(model)}' is not supported; {known}.")
    sides = [
        float(_numbers(values[key], f"{source}: '{key}'", (1,))[0])
        for keys in _SIZE_KEYS
        for key in keys
        if set(keys) <= values.keys()
    ]
    return GivenIntrinsics(
        matrix=_matrix(values, source),
        distortion=tuple(
            _numbers(_first(values, _DISTORTION_KEYS, []), f"{source}: the distortion")
        ),
        size=(int(sides[0]), int(sides[1])) if sides else None,
        source=source,
    )


def _matrix(values: Mapping[str, Any], source: str) -> Matrix3:
    given = _first(values, _MATRIX_KEYS, None)
    if given is not None:
        a, b, c, d, e, f, g, h, i = _numbers(given, f"{source}: the camera matrix", (9,))
        return (a, b, c), (d, e, f), (g, h, i)
    if not {"fx", "fy", "cx", "cy"} <= values.keys():
        keys = one_line(", ".join(f"'{key}'" for key in list(values)[:8])) or "none"
        raise CalibrationDataError(f"{source}: no camera matrix (K or fx, fy, cx, cy), got {keys}.")
    return _pinhole(*_numbers([values[k] for k in ("fx", "fy", "cx", "cy")], source, (4,)))


def _pinhole(fx: float, fy: float, cx: float, cy: float) -> Matrix3:
    return (fx, 0.0, cx), (0.0, fy, cy), (0.0, 0.0, 1.0)


def _first(values: Mapping[str, Any], keys: Sequence[str], default: Any) -> Any:  # noqa: ANN401
    return next((values[key] for key in keys if values.get(key) is not None), default)


def _numbers(value: Any, where: str, counts: tuple[int, ...] = ()) -> list[float]:  # noqa: ANN401
    """Flatten a list, a list of lists or a ROS matrix (rows, cols, data) of finite numbers."""
    value = value.get("data", []) if isinstance(value, Mapping) else value
    return finite_numbers(value, where, counts).tolist()


def _read(path: Path) -> Mapping[str, Any]:
    text = read_text(path, CalibrationDataError)
    words = text.replace(",", " ").split()
    if "opencv-matrix" in text or text.startswith("%YAML:") or text.lstrip().startswith("<"):
        values = _file_storage(text, str(path))
    elif len(words) == any_numbers(words).size == 9:
        values = {"K": words}
    else:
        values = parse_yaml(text, str(path), CalibrationDataError)
    if not isinstance(values, Mapping):
        raise CalibrationDataError(f"{path}: expected keys, got {type(values).__name__}.")
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
    except (ElementTree.ParseError, ValueError) as error:
        reason = one_line(str(error).removeprefix(f"{source}: "))
        raise CalibrationDataError(f"{source}: not a readable OpenCV file ({reason}).") from None
    for key, value in values.items() if isinstance(values, Mapping) else ():
        if not isinstance(value, Mapping) or "data" not in value:
            continue
        count = len(value["data"]) if isinstance(value["data"], list) else "no list"
        rows, columns = (one_line(str(value.get(name))) for name in ("rows", "cols"))
        sides = any_numbers([rows, columns])
        if not sides.size or count != sides.prod():
            got = f"got {count} for {rows} x {columns}"
            raise CalibrationDataError(f"{source}: '{key}' must have rows x cols numbers, {got}.")
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
        first = one_line(str(next(iter(cameras))))
        raise CalibrationDataError(f"{source} holds {one_line(listed)}. Name one: 'FILE#{first}'.")
    entry = cameras[camera] if camera in cameras else next(iter(cameras.values()))
    models = str(entry["camera_model"]), str(entry.get("distortion_model", "none"))
    if models not in (("pinhole", "radtan"), ("pinhole", "none")):
        said = one_line("', '".join(models))
        raise CalibrationDataError(f"{source}: '{said}' is not supported; take pinhole-radtan.")
    fx, fy, cx, cy = _numbers(entry["intrinsics"], f"{source}: 'intrinsics'", (4,))
    found = {"K": _pinhole(fx, fy, cx, cy), "distortion": entry.get("distortion_coeffs", [])}
    if "resolution" in entry:
        found["width"], found["height"] = _numbers(
            entry["resolution"], f"{source}: 'resolution'", (2,)
        )
    return found
