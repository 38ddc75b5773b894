"""The calibration as a YAML file of cv::FileStorage, written as text: OpenCV is not needed."""

import json
import math
import re
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from tofcorr.correction.corrector import DepthCorrector
from tofcorr.correction.export.pose import Mount, write_pose
from tofcorr.correction.state import CalibrationState
from tofcorr.error_terms.model import ErrorModel

Value = str | int | float | np.ndarray | Sequence[Mapping[str, "Value"]]
"""What a key of cv::FileStorage may hold; matrices have two dimensions, written as double."""

_HEADER = "%YAML:1.0\n---\n"
_MATRIX_TAG = "!!opencv-matrix"
_INDENT = "   "


def export_opencv(corrector: DepthCorrector, path: Path | str, reference: CalibrationState) -> None:
    """Write intrinsics, the camera's pose, validity and coefficients, each with its unit.

    `camera_matrix` and `distortion_coefficients` have the names of OpenCV's calibration sample.
    `coefficients` is a list of `group`, `symbol`, `value`, `unit`: the paper's symbols on unscaled
    variables. A term without a form in the paper gives the coefficients of its basis functions,
    which `terms` describes. A residual network is not in the file, and `left_out` says so.

    Args:
        corrector: Where the metadata come from.
        path: The file to write; an older one is replaced.
        reference: The calibration that the file must agree with.

    Raises:
        ExportError: What was written is not the calibration, or the file cannot be written.
    """
    mount = Mount(reference, "opencv") if reference.hand_eye_estimated else None
    values = _content(json.loads(corrector.metadata()), reference, mount)
    text = _HEADER + "".join(_entry(key, value, "") for key, value in values.items())
    write_pose(path, text, lambda part: read_matrix(part, "tool_from_camera"), mount)


def _content(metadata: dict, state: CalibrationState, mount: Mount | None) -> dict[str, Value]:
    camera, validity, error = state.camera, metadata["validity"], state.model().error
    content: dict[str, Value] = {
        "format": "tofcorr-opencv",
        "version": 1,
        "tofcorr": metadata["versions"]["tofcorr"],
        "model": state.name,
        "image_width": camera.width,
        "image_height": camera.height,
        "camera_matrix": np.array(camera.matrix),
        # OpenCV takes no empty matrix for a lens without distortion; k1 k2 p1 p2 k3 of zero say the
        # same.
        "distortion_coefficients": np.array([camera.distortion or (0.0,) * 5]),
        "depth_kind": state.depth_kind,
        **_pose(mount),
        "sign": metadata["sign"],
        "error_is_along": "the viewing ray, metres",
        "radial_distance_m": np.array([validity["radial_distance_m"]]),
        "coefficients": _coefficients(error),
        "terms": json.dumps(metadata["terms"]),
        "left_out": "" if state.residual is None else "the residual network",
    }
    if validity["amplitude"] is not None:
        content["amplitude_range"] = np.array([validity["amplitude"]])
    if error.fixed_pattern is not None:
        content["fixed_pattern_m"] = error.fixed_pattern.offset.detach().cpu().numpy()
    return content


def _pose(mount: Mount | None) -> dict[str, Value]:
    if mount is None:
        return {"hand_eye_estimated": 0}
    pose: dict[str, Value] = {
        "hand_eye_estimated": 1,
        "eye_to_hand": int(mount.frames.eye_to_hand),
        "parent_frame": mount.frames.tool,
        "camera_frame": mount.frames.camera,
        "tool_from_camera": mount.transform,
    }
    if mount.accuracy is not None:
        pose["translation_standard_errors_mm"] = np.array([mount.accuracy.translation_se_mm])
        pose["rotation_standard_errors_deg"] = np.array([mount.accuracy.rotation_se_deg])
        pose["not_determined"] = "; ".join(mount.accuracy.undetermined)
    return pose


def _coefficients(error: ErrorModel) -> list[dict[str, Value]]:
    units = error.paper_units()
    return [
        {"group": group, "symbol": symbol, "value": value, "unit": units[group][symbol]}
        for group, named in error.paper_coefficients().items()
        for symbol, value in named.items()
    ]


def read_matrix(path: Path, key: str) -> np.ndarray:
    """Return a matrix of a file that `export_opencv` wrote; empty if there is none."""
    text = path.read_text(encoding="utf-8")
    pattern = rf"^{key}: {_MATRIX_TAG}\s+rows: (\d+)\s+cols: (\d+)\s+dt: d\s+data: \[([^\]]*)\]"
    found = re.search(pattern, text, re.MULTILINE)
    if found is None:
        return np.zeros((0, 0))
    numbers = [float(word) for word in found[3].split(",")]
    return np.array(numbers).reshape(int(found[1]), int(found[2]))


def _entry(key: str, value: Value, indent: str) -> str:
    if isinstance(value, np.ndarray):
        rows, columns = value.shape
        inner = indent + _INDENT
        lines = (", ".join(_number(number) for number in row) for row in value.tolist())
        data = f",\n{inner}{_INDENT}".join(lines)
        return (
            f"{indent}{key}: {_MATRIX_TAG}\n{inner}rows: {rows}\n{inner}cols: {columns}\n"
            f"{inner}dt: d\n{inner}data: [ {data} ]\n"
        )
    if isinstance(value, str):
        escaped = value.replace("\\", "\\\\").replace('"', '\\"')
        return f'{indent}{key}: "{escaped}"\n'
    if isinstance(value, int):
        return f"{indent}{key}: {value}\n"
    if isinstance(value, float):
        return f"{indent}{key}: {_number(value)}\n"
    inner = indent + 2 * _INDENT
    items = (
        f"{indent}{_INDENT}-\n" + "".join(_entry(name, one, inner) for name, one in item.items())
        for item in value
    )
    return f"{indent}{key}:\n" + "".join(items)


def _number(value: float) -> str:
    """Return a float with all its digits, as OpenCV reads it."""
    if math.isnan(value):
        return ".NaN"
    if math.isinf(value):
        return ".Inf" if value > 0 else "-.Inf"
    return f"{value:.16e}"
