"""The file `recording.yaml`: the camera and the recording, and the rigid transforms in files."""

from collections.abc import Mapping
from difflib import get_close_matches
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import AfterValidator, BeforeValidator, ConfigDict

from tofcorr.errors import CalibrationDataError, ConfigError
from tofcorr.geometry.camera import CameraIntrinsics, CameraSection, DepthKind, FrameNames
from tofcorr.options import Options, dump_yaml, read_yaml
from tofcorr.options.numbers import Number, PositiveNumber, not_a_truth_value

FILE_NAME = "recording.yaml"
PlaneOrigin = Literal["recorded", "estimated"]
"""`recorded`: measured by other means; `estimated`: found in the depth itself, never truth."""

# Largest size of a header, bytes. Set by hand: a header has about twenty lines.
_LARGEST_HEADER_BYTES = 1_000_000
# Largest deviation of a rotation from an orthonormal matrix (no unit): rounding to three digits.
_TOLERANCE = 1e-3
# Smallest deviation that is corrected (no unit): smaller ones are rounding errors of float64.
_EXACT = 1e-12

Row4 = tuple[Number, Number, Number, Number]


def _rigid(rows: tuple[Row4, Row4, Row4, Row4]) -> tuple[Row4, Row4, Row4, Row4]:
    refuse_unless_rigid(np.array(rows))
    return rows


RigidTransform = Annotated[tuple[Row4, Row4, Row4, Row4], AfterValidator(_rigid)]
"""A rigid transform as four rows."""


class Header(Options):
    """The content of `recording.yaml`; keys of other tools are ignored."""

    model_config = ConfigDict(extra="ignore")

    format: Literal["tofcorr-recording"] = "tofcorr-recording"
    version: Annotated[Literal[1], BeforeValidator(not_a_truth_value)] = 1
    camera: CameraSection
    depth_kind: DepthKind
    modulation_frequency_hz: PositiveNumber | None = None
    saturation_amplitude: PositiveNumber | None = None
    tool_from_camera: RigidTransform = tuple(map(tuple, np.eye(4).tolist()))  # type: ignore[assignment]
    planes: PlaneOrigin = "recorded"
    frames: FrameNames = FrameNames()

    def tool_from_camera_matrix(self) -> np.ndarray:
        """Return the guess of the hand-eye transform, shape (4, 4), its rotation exact.

        Because of rounding in the file, the rotation may differ from an orthonormal one by up to
        1e-3. The nearest rotation is returned.
        """
        return nearest_rigid(np.array(self.tool_from_camera, dtype=np.float64))


def build_header(
    camera: CameraIntrinsics,
    depth_kind: DepthKind,
    modulation_frequency: float | None,
    saturation_amplitude: float | None,
    tool_from_camera: np.ndarray | None,
    planes: PlaneOrigin = "recorded",
    frame_names: FrameNames | None = None,
) -> Header:
    """Check the arguments of a writer and build the header from them.

    Raises:
        CalibrationDataError: A value is not allowed in `recording.yaml`.
    """
    values: dict[str, Any] = {
        "camera": camera.section(),
        "depth_kind": depth_kind,
        "modulation_frequency_hz": modulation_frequency,
        "saturation_amplitude": saturation_amplitude,
        "planes": planes,
        "frames": (frame_names or FrameNames()).to_mapping(),
    }
    if tool_from_camera is not None:
        values["tool_from_camera"] = np.asarray(tool_from_camera, dtype=np.float64).tolist()
    return _validated(values, FILE_NAME)


def read_header(path: Path) -> Header:
    """Read and check `recording.yaml`.

    Raises:
        CalibrationDataError: The file is missing or breaks the format; the message names the key.
    """
    try:
        if path.stat().st_size > _LARGEST_HEADER_BYTES:
            raise CalibrationDataError(f"{path}: larger than 1 MB, so not a {FILE_NAME}.")
    except OSError as error:
        raise CalibrationDataError(f"{path}: cannot be read ({error.strerror}).") from None
    try:
        values = read_yaml(path)
    except ConfigError as error:
        raise CalibrationDataError(str(error)) from None
    if not isinstance(values, Mapping):
        raise CalibrationDataError(
            f"{path}: expected keys and values, got {type(values).__name__}."
        )
    # Their defaults are for the writer; a file must contain both.
    for key in ("format", "version"):
        if key not in values:
            raise CalibrationDataError(f"{path}: '{key}' is missing; is this a recording?")
    _refuse_misspelt(values, path)
    return _validated(values, str(path))


def header_text(header: Header) -> str:
    """Return the header as the text of `recording.yaml`; optional keys only where they say more."""
    values = header.to_mapping()
    for key in ("planes", "frames"):
        if getattr(header, key) == Header.model_fields[key].default:
            del values[key]
    return dump_yaml(values, last="depth_kind")


def _validated(values: Mapping[str, Any], where: str) -> Header:
    if values.get("tool_from_camera", ()) is None:  # null: unknown, so the identity.
        values = {key: value for key, value in values.items() if key != "tool_from_camera"}
    try:
        return Header.from_mapping(values, where)
    except ConfigError as error:
        raise CalibrationDataError(str(error)) from None


def _refuse_misspelt(values: Mapping[str, Any], path: Path) -> None:
    """Refuse an unknown key that resembles a known key which is missing."""
    absent = [key for key in Header.model_fields if key not in values]
    for key in values:
        close = get_close_matches(str(key), absent, n=1, cutoff=0.8)
        if key not in Header.model_fields and close:
            raise CalibrationDataError(
                f"{path}: '{key}' is not a known key. Did you mean '{close[0]}'?"
            )


def refuse_unless_rigid(matrix: np.ndarray) -> None:
    """Refuse a matrix that is not a finite rigid transform of shape (4, 4).

    Raises:
        ValueError: It is not; the message says why.
    """
    if matrix.shape != (4, 4) or not np.isfinite(matrix).all():
        raise ValueError("expected a 4x4 matrix of finite numbers")
    if np.any(matrix[3] != [0, 0, 0, 1]):
        raise ValueError("the last row of a rigid transform is 0 0 0 1")
    rotation = matrix[:3, :3]
    # Entries above 2 cannot belong to a rotation, and their squares may overflow.
    if np.abs(rotation).max() > 2 or (
        np.abs(rotation @ rotation.T - np.eye(3)).max() > 2 * _TOLERANCE
    ):
        raise ValueError("the upper left 3x3 block must be a rotation: orthonormal, to 0.001")
    if np.linalg.det(rotation) < 0:
        raise ValueError("the upper left 3x3 block is a reflection, not a rotation")


def nearest_rigid(matrix: np.ndarray) -> np.ndarray:
    """Return the transform with its rotation made exact, shape (4, 4).

    Because of rounding in a file a rotation is only nearly orthonormal; the nearest rotation is
    returned.
    """
    left, _, right = np.linalg.svd(matrix[:3, :3])
    exact = matrix.copy()
    if np.abs(left @ right - matrix[:3, :3]).max() > _EXACT:
        exact[:3, :3] = left @ right
    return exact
