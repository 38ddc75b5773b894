"""The calibration as a YAML file of cv::FileStorage, written as text: OpenCV is not needed."""

import json
from pathlib import Path

import numpy as np

from tofcorr.correction.corrector import DepthCorrector
from tofcorr.correction.export.file_storage import Value, file_storage_text, read_matrix
from tofcorr.correction.export.mount import Mount, require_same
from tofcorr.correction.state import CalibrationState
from tofcorr.error_terms.model import ErrorModel
from tofcorr.files.staged import staged_file

# OpenCV takes no empty matrix for a lens without distortion; k1 k2 p1 p2 k3 of zero say the same.
_NO_DISTORTION = (0.0,) * 5


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
    values = _content(json.loads(corrector.metadata()), reference)
    with staged_file(path) as part:
        part.write_text(file_storage_text(values), encoding="utf-8")
        if reference.hand_eye_estimated:
            found = read_matrix(part, "tool_from_camera")
            require_same(path, found, Mount.of(reference, "opencv"))


def _content(metadata: dict, state: CalibrationState) -> dict[str, Value]:
    camera, validity, error = state.camera, metadata["validity"], state.model().error
    content: dict[str, Value] = {
        "format": "tofcorr-opencv",
        "version": 1,
        "tofcorr": metadata["versions"]["tofcorr"],
        "model": state.name,
        "image_width": camera.width,
        "image_height": camera.height,
        "camera_matrix": np.array(camera.matrix),
        "distortion_coefficients": np.array([camera.distortion or _NO_DISTORTION]),
        "depth_kind": state.depth_kind,
        **_pose(state),
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


def _pose(state: CalibrationState) -> dict[str, Value]:
    if not state.hand_eye_estimated:
        return {"hand_eye_estimated": 0}
    mount = Mount.of(state, "opencv")
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
