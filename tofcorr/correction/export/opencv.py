"""The calibration as a YAML file of cv::FileStorage."""

import json
from pathlib import Path
from typing import Any

import numpy as np

from tofcorr.correction.corrector import DepthCorrector
from tofcorr.correction.export.pose import Mount
from tofcorr.correction.state import CalibrationState
from tofcorr.error_terms.model import ErrorModel
from tofcorr.files import staged_file

Value = str | int | float | np.ndarray | list[dict[str, "Value"]]
"""What a key of cv::FileStorage may hold; matrices have two dimensions, written as double."""


def export_opencv(corrector: DepthCorrector, path: Path | str, reference: CalibrationState) -> None:
    """Write intrinsics, the camera's pose, validity and coefficients, each with its unit.

    `camera_matrix` and `distortion_coefficients` have the names of OpenCV's calibration sample.
    `coefficients` is a list of `group`, `symbol`, `value`, `unit`: the paper's symbols on unscaled
    variables. A term without a form in the paper gives the coefficients of its basis functions,
    which `terms` describes. A residual network is not in the file, and `left_out` says so.

    Args:
        corrector: Where the metadata come from.
        path: The file to write; an older one is replaced.
        reference: The calibration.

    Raises:
        ExportError: The file cannot be written.
    """
    import cv2

    mount = Mount(reference, "opencv") if reference.hand_eye_estimated else None

    with staged_file(path) as part:
        storage = cv2.FileStorage(str(part), cv2.FILE_STORAGE_WRITE | cv2.FILE_STORAGE_FORMAT_YAML)
        for key, value in _content(json.loads(corrector.metadata()), reference, mount).items():
            _put(storage, key, value)
        storage.release()


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
    return [
        {"group": group, "symbol": symbol, "value": value, "unit": unit}
        for group, named in error.paper_values().items()
        for symbol, (value, unit) in named.items()
    ]


def _put(storage: Any, key: str, value: Value) -> None:  # noqa: ANN401 - cv2.FileStorage
    """Write an entry; those of a list of mappings one below the other."""
    if not isinstance(value, list):
        storage.write(key, value)
        return
    import cv2

    storage.startWriteStruct(key, cv2.FILE_NODE_SEQ)
    for item in value:
        storage.startWriteStruct("", cv2.FILE_NODE_MAP)
        for name, one in item.items():
            _put(storage, name, one)
        storage.endWriteStruct()
    storage.endWriteStruct()
