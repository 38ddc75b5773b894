"""BlenderProc's HDF5 files: one an image, with depth and, where written, the camera's pose."""

import json
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from tofcorr.data.header import DepthKind
from tofcorr.errors import CalibrationDataError
from tofcorr.geometry.camera import CameraIntrinsics
from tofcorr.importing.given_intrinsics import GivenIntrinsics
from tofcorr.importing.images.series import find_series
from tofcorr.importing.intrinsics_file import intrinsics_from_mapping
from tofcorr.importing.poses.track import PoseTrack
from tofcorr.importing.report import RefusedViewError
from tofcorr.importing.source import DepthImage

_KEYS: dict[str, DepthKind] = {"depth": "z", "distance": "radial"}
"""The names of depth in these files, and what they mean."""

_POSE_KEYS = ("cam2world_matrix", "cam2world", "cam_pose")
_STATE = "campose"
"""Text of the camera's state (BlenderProc's CameraStateWriter)."""

_BACKGROUND = 1e4
"""Metres from which on nothing was hit: Blender writes 1e10."""

_CAMERA_OF_BLENDER = np.diag([1.0, -1.0, -1.0, 1.0])
"""Blender's camera looks along -z with y up; OpenCV's along z with y down."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Hdf5Scene:
    """Depth images of a folder of HDF5 files; a `tofcorr.importing.source.DepthSource`.

    Attributes:
        origin: The folder.
        names: Of the files.
        times: None: rendered images have none.
        camera: The camera's intrinsics.
        depth_kind: What depth means.
        track: The camera's poses, in the order of the images.
    """

    origin: str
    names: Sequence[str]
    times: None
    camera: CameraIntrinsics
    depth_kind: DepthKind
    track: PoseTrack
    _paths: Sequence[Path]
    _key: str

    def read(self, number: int) -> DepthImage:
        """Read one image.

        Raises:
            RefusedViewError: It cannot be read, or is of another size.
        """
        try:
            with _opened(self._paths[number]) as file:
                depth = _image(file, self._key, self._paths[number])
        except CalibrationDataError as error:
            raise RefusedViewError(str(error).rstrip(".")) from None
        if depth.shape != (self.camera.height, self.camera.width):
            raise RefusedViewError(
                f"it has {depth.shape[1]}x{depth.shape[0]} pixels, the others "
                f"{self.camera.width}x{self.camera.height}"
            )
        usable = np.isfinite(depth) & (depth > 0) & (depth < _BACKGROUND)
        return DepthImage(np.where(usable, depth, np.nan).astype(np.float32))


def open_hdf5(folder: Path, intrinsics: GivenIntrinsics | None) -> Hdf5Scene:
    """Open a folder of HDF5 files.

    Args:
        folder: It holds `0.hdf5`, `1.hdf5`, ....
        intrinsics: The camera's; None: as in the files.

    Raises:
        CalibrationDataError: A file is damaged, or has no depth, pose or intrinsics; or the package
            h5py is missing.
    """
    series = find_series(folder, "*.hdf5", "HDF5")
    with _opened(series.paths[0]) as file:
        key = next((key for key in _KEYS if key in file), None)
        if key is None:
            listed = ", ".join(file) or "nothing"
            raise CalibrationDataError(
                f"{series.paths[0]}: expected 'depth' or 'distance', found {listed}."
            )
        height, width = _image(file, key, series.paths[0]).shape
        given = intrinsics or _intrinsics(file, series.paths[0])
    poses = []
    for path in series.paths:
        with _opened(path) as file:
            poses.append(_world_from_camera(file, path))
    return Hdf5Scene(
        origin=str(folder),
        names=series.views,
        times=None,
        camera=given.camera((width, height)),
        depth_kind=_KEYS[key],
        track=PoseTrack.checked(np.stack(poses), str(folder)),
        _paths=series.paths,
        _key=key,
    )


@contextmanager
def _opened(path: Path) -> Iterator[Any]:
    """Open a file; what the library raises on damaged bytes becomes one sentence."""
    try:
        import h5py
    except ImportError:
        raise CalibrationDataError(
            f"{path}: HDF5 needs the package h5py: pip install 'tofcorr[hdf5]'"
        ) from None
    try:
        with h5py.File(path, "r") as file:
            yield file
    except (OSError, RuntimeError, KeyError, TypeError) as error:
        raise CalibrationDataError(f"{path}: not a readable HDF5 file ({error}).") from None


def _image(file: Any, key: str, path: Path) -> np.ndarray:  # noqa: ANN401 - of h5py
    depth = np.asarray(file[key])
    if depth.ndim == 3 and depth.shape[2] == 1:
        depth = depth[:, :, 0]
    if depth.ndim != 2 or not depth.size or depth.dtype.kind not in "fiu":
        raise CalibrationDataError(
            f"{path}: '{key}' must be one image of shape (rows, columns), got {depth.shape}."
        )
    return depth.astype(np.float64)


def _state(file: Any) -> dict[str, Any]:  # noqa: ANN401 - of h5py
    """Return the camera's state; empty where there is none."""
    if _STATE not in file:
        return {}
    try:
        state = json.loads(bytes(np.asarray(file[_STATE][()])).decode("utf-8"))
    except (ValueError, UnicodeDecodeError):
        return {}
    state = state[0] if isinstance(state, list) and state else state
    return state if isinstance(state, dict) else {}


def _world_from_camera(file: Any, path: Path) -> np.ndarray:  # noqa: ANN401 - of h5py
    state = _state(file)
    given = next((np.asarray(file[key]) for key in _POSE_KEYS if key in file), None)
    if given is None:
        given = state.get("cam2world_matrix")
    try:
        pose = np.asarray(given, dtype=np.float64)
    except (TypeError, ValueError, OverflowError):
        pose = np.zeros(0)
    if pose.shape != (4, 4):
        raise CalibrationDataError(
            f"{path}: no pose of the camera; expected one of {', '.join(_POSE_KEYS)} (4x4, "
            f"Blender's axes) or '{_STATE}'. Write it with the images, as "
            "bproc.camera.get_camera_pose(frame) gives it."
        )
    return pose @ _CAMERA_OF_BLENDER


def _intrinsics(file: Any, path: Path) -> GivenIntrinsics:  # noqa: ANN401 - of h5py
    key = next((key for key in ("cam_K", "K") if key in file), None)
    matrix = np.asarray(file[key]).tolist() if key else _state(file).get("cam_K")
    if matrix is None:
        raise CalibrationDataError(f"{path}: no intrinsics ('cam_K'); name a file: --intrinsics.")
    return intrinsics_from_mapping({"K": matrix}, str(path))
