"""Camera intrinsics as files and users give them, before the size of the images is known.

Every program has its own keys for the same few numbers; `_file_storage` reads OpenCV's own format.
"""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

from tofcorr.errors import CalibrationDataError
from tofcorr.geometry.camera import CameraIntrinsics, CameraSection, Matrix3
from tofcorr.importing.numbers import any_numbers, finite_numbers
from tofcorr.options import is_shipped_name, one_line, parse_yaml, read_text, shipped_file

# Ours and recording.yaml; ROS camera_info; OpenCV's samples; iai_kinect2; MATLAB-style scripts;
# Kalibr, whose pinhole-radtan is OpenCV's model.
_MATRIX_KEYS = ("K", "matrix", "camera_matrix", "cameraMatrix", "Camera_Matrix", "mtx")
_DISTORTION_KEYS = (
    *("distortion", "D", "distortion_coefficients", "distortionCoefficients"),
    *("Distortion_Coefficients", "distCoeffs", "dist_coeffs", "dist", "distortion_coeffs"),
)
_SIZE_KEYS = (("width", "height"), ("image_width", "image_height"), ("image_Width", "image_Height"))
_MODELS = ("plumb_bob", "rational_polynomial", "opencv", "none", "pinhole", "radtan")


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
        CameraSection.from_mapping(camera.section(), self.source, CalibrationDataError)
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
    values = _of_camera(values, source, camera)
    for model in (values.get("camera_model"), values.get("distortion_model")):
        if isinstance(model, str) and model.lower() not in _MODELS:
            known = "expected a pinhole with OpenCV's plumb_bob (radtan) or rational_polynomial"
            raise CalibrationDataError(f"{source}: '{one_line(model)}' is not supported; {known}.")
    size = next((keys for keys in _SIZE_KEYS if set(keys) <= values.keys()), ())
    given = [values[key] for key in size] or values.get("resolution", [])
    distortion = _first(values, _DISTORTION_KEYS, [])
    return GivenIntrinsics(
        matrix=_matrix(values, source),
        distortion=tuple(_numbers(distortion, f"{source}: the distortion")),
        size=tuple(map(int, _numbers(given, f"{source}: the size", (0, 2)))) or None,  # type: ignore[arg-type]
        source=source,
    )


def _of_camera(values: Mapping[str, Any], source: str, camera: str | None) -> Mapping[str, Any]:
    """Return what a file says of one camera: at the top, below `camera`, or below its name."""
    below, single = values.get("camera"), {"intrinsics", "camera_model"}
    named = {k: v for k, v in values.items() if isinstance(v, Mapping) and single <= v.keys()}
    if not named:
        return below if isinstance(below, Mapping) else values
    if camera is None and len(named) == 1:
        (camera,) = named
    if camera not in named:
        listed = ", ".join(f"{name} ({one.get('rostopic', '?')})" for name, one in named.items())
        first = one_line(str(next(iter(named))))
        raise CalibrationDataError(f"{source} holds {one_line(listed)}. Name one: 'FILE#{first}'.")
    return named[camera]


def _matrix(values: Mapping[str, Any], source: str) -> Matrix3:
    given = _first(values, _MATRIX_KEYS, None)
    if given is not None:
        a, b, c, d, e, f, g, h, i = _numbers(given, f"{source}: the camera matrix", (9,))
        return (a, b, c), (d, e, f), (g, h, i)
    four = [values.get(name) for name in ("fx", "fy", "cx", "cy")]
    if None in four and "intrinsics" not in values:
        keys = one_line(", ".join(f"'{key}'" for key in list(values)[:8])) or "none"
        raise CalibrationDataError(f"{source}: no camera matrix (K or fx, fy, cx, cy), got {keys}.")
    return _pinhole(*_numbers(values.get("intrinsics", four), f"{source}: the intrinsics", (4,)))


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
        CalibrationDataError: It is none of them.
    """
    if text.lstrip().startswith("<"):
        return _xml(text, source)
    # JSON is YAML too; OpenCV's first line and its tags are not.
    plain = re.sub(r"\A%YAML[: ][^\n]*|!!opencv-[a-z-]+", "", text)
    return parse_yaml(plain, source, CalibrationDataError)


def _xml(text: str, source: str) -> dict[str, Any]:
    """Return the elements of an XML text by their names: text, or what a matrix consists of."""
    if "<!" in text.replace("<!--", ""):
        raise CalibrationDataError(f"{source}: declares entities, which OpenCV's files never do.")
    try:
        elements = list(ElementTree.fromstring(text))
    except (ElementTree.ParseError, ValueError) as error:
        raise CalibrationDataError(f"{source}: not a readable OpenCV file ({error}).") from None
    found: dict[str, Any] = {}
    for element in elements:
        parts = {one.tag: (one.text or "").strip() for one in element}
        found[element.tag] = (element.text or "").strip().strip('"')
        if "data" in parts:
            found[element.tag] = parts | {"data": parts["data"].split()}
    return found
