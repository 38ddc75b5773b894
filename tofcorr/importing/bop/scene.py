"""Scenes whose poses are the camera's own: BOP's layout, and BlenderProc's HDF5 files."""

import json
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from tofcorr.errors import CalibrationDataError, ConfigError
from tofcorr.importing.frames.source import open_folder
from tofcorr.importing.images import DepthCoding, DepthImage, matching_files, of_size
from tofcorr.importing.intrinsics import (
    GivenIntrinsics,
    intrinsics_from_mapping,
    read_named_intrinsics,
)
from tofcorr.importing.numbers import any_numbers
from tofcorr.importing.pose_track import PoseTrack
from tofcorr.importing.posed import import_posed
from tofcorr.importing.robot_images import PosedOptions, RobotImages
from tofcorr.importing.run import Progress, RefusedViewError, no_progress

_FILE_NAME = "scene_camera.json"
_POSE_KEYS = ("cam2world_matrix", "cam2world", "cam_pose")
_STATE = "campose"
"""Text of the camera's state (BlenderProc's CameraStateWriter)."""


def import_scene(
    scene: Path,
    out: Path,
    options: PosedOptions,
    *,
    amplitude: str | None = None,
    intrinsics: str | None = None,
    progress: Progress = no_progress,
) -> dict[str, Any]:
    """Turn a scene in BOP's layout, or a folder of HDF5 files, into a recording.

    Args:
        scene: The folder.
        out: The recording to write; it must not exist yet.
        options: How to choose images and look for walls.
        amplitude: Names of amplitude images; BOP alone.
        intrinsics: A file or a shipped name; HDF5 alone.
        progress: Shows how far a step has come.

    Raises:
        CalibrationDataError: The scene lacks something, such as poses; the message says what.
        ConfigError: An option belongs to the other layout.
    """
    path = scene / _FILE_NAME
    if not path.exists() and any(scene.glob("*.hdf5")):
        if amplitude is not None:
            raise ConfigError("--amplitude is for BOP's layout; HDF5 scenes have no amplitudes.")
        given = None if intrinsics is None else read_named_intrinsics(intrinsics)
        source, key = _open_hdf5(scene, given)
        kind = "z" if key == "depth" else "radial"
        options = options.model_copy(update={"depth_kind": kind})
    else:
        if intrinsics is not None:
            raise ConfigError(f"--intrinsics is for HDF5; a BOP scene states them in {_FILE_NAME}.")
        lens, unit_mm, track = read_scene_camera(path)
        source = open_folder(
            scene,
            "depth/*.png",
            lens,
            DepthCoding(unit_mm=unit_mm),
            track,
            amplitude_pattern=amplitude,
            tool_from_camera=np.eye(4),
        )
    return import_posed(source, out, options, progress)


def read_scene_camera(path: Path) -> tuple[GivenIntrinsics, float, PoseTrack]:
    """Read BOP's `scene_camera.json`.

    Returns:
        The intrinsics of the one camera; millimetres per count of depth (`depth_scale`); and the
        poses of the camera in the world, named as the images are (`000012`).

    Raises:
        CalibrationDataError: It cannot be read, images have different intrinsics or units, or there
            are no poses.
    """
    images = _read(path)
    first = next(iter(images))
    for key in ("cam_K", "depth_scale"):
        lacking = next((name for name, image in images.items() if key not in image), None)
        if lacking is not None:
            raise CalibrationDataError(f"{path}: image {lacking} has no '{key}'.")
        other = next((n for n, i in images.items() if i[key] != images[first][key]), None)
        if other is not None:
            raise CalibrationDataError(
                f"{path}: '{key}' of image {other} differs from that of image {first}; expected "
                "one camera and one unit a scene."
            )
    posed = {n: i for n, i in images.items() if "cam_R_w2c" in i and "cam_t_w2c" in i}
    if not posed:
        raise CalibrationDataError(
            f"{path}: no image has a pose of the camera ('cam_R_w2c', 'cam_t_w2c'). BOP's poses of "
            "objects do not tell where the camera is; without poses a hand-eye transform cannot be "
            "estimated."
        )
    poses = np.tile(np.eye(4), (len(posed), 1, 1))
    for pose, (name, image) in zip(poses, posed.items(), strict=True):
        # The pose is inverted; its translation is in millimetres.
        rotation = _numbers(image, "cam_R_w2c", 9, f"{path}: image {name}").reshape(3, 3).T
        translation = _numbers(image, "cam_t_w2c", 3, f"{path}: image {name}") / 1000
        pose[:3, :3], pose[:3, 3] = rotation, -rotation @ translation
    where = f"{path}: image {first}"
    (unit,) = _numbers(images[first], "depth_scale", 1, where)
    if unit <= 0:
        raise CalibrationDataError(f"{path}: 'depth_scale' must be positive, got {unit:g}.")
    matrix = _numbers(images[first], "cam_K", 9, where).tolist()
    track = PoseTrack.checked(poses, str(path), names=[f"{int(name):06d}" for name in posed])
    return intrinsics_from_mapping({"K": matrix}, str(path)), float(unit), track


def _numbers(image: dict[str, Any], key: str, count: int, where: str) -> np.ndarray:
    values = any_numbers(image[key]).ravel()
    if values.size != count or not np.isfinite(values).all():
        raise CalibrationDataError(
            f"{where}: '{key}' must be {count} finite number{'s' if count > 1 else ''}, got "
            f"{str(image[key])[:60]}."
        )
    return values


def _read(path: Path) -> dict[str, dict[str, Any]]:
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise CalibrationDataError(
            f"{path}: cannot be read ({error.strerror}); a BOP scene holds {_FILE_NAME} and depth/."
        ) from None
    except (ValueError, RecursionError) as error:
        raise CalibrationDataError(f"{path}: not readable JSON ({error}).") from None
    whole = isinstance(content, dict) and bool(content)
    if not whole or not all(n.isdecimal() and isinstance(i, dict) for n, i in content.items()):
        raise CalibrationDataError(
            f"{path}: expected an object with one entry an image, by its number."
        )
    return content


def _open_hdf5(folder: Path, intrinsics: GivenIntrinsics | None) -> tuple[RobotImages, str]:
    """Open a folder of BlenderProc's files `0.hdf5`, `1.hdf5`, ..., one an image.

    Args:
        folder: The folder.
        intrinsics: The camera's; None: as in the files.

    Returns:
        Images and poses, and the name of depth in the files: `depth` along the optical axis, or
        `distance` along the ray.

    Raises:
        CalibrationDataError: A file is damaged, or has no depth, pose or intrinsics; or the package
            h5py is missing.
    """
    found = matching_files(folder, "*.hdf5", "HDF5")
    paths = list(found.values())
    with _opened(paths[0]) as file:
        key = next((key for key in ("depth", "distance") if key in file), None)
        if key is None:
            listed = ", ".join(file) or "nothing"
            raise CalibrationDataError(
                f"{paths[0]}: expected 'depth' or 'distance', found {listed}."
            )
        if intrinsics is None:
            matrix = _value(file, ("cam_K", "K"))
            if matrix is None:
                raise CalibrationDataError(
                    f"{paths[0]}: no intrinsics ('cam_K'); name a file: --intrinsics."
                )
            values = {"K": np.asarray(matrix).tolist()}
            intrinsics = intrinsics_from_mapping(values, str(paths[0]))
        height, width = _image(file, key, paths[0]).shape
        camera = intrinsics.camera((width, height))
    poses = np.stack([_world_from_camera(path) for path in paths])

    def read(number: int) -> DepthImage:
        try:
            with _opened(paths[number]) as file:
                depth = _image(file, key, paths[number])
        except CalibrationDataError as error:
            raise RefusedViewError(str(error).rstrip(".")) from None
        # Blender writes 1e10 m where nothing was hit.
        usable = np.isfinite(depth) & (depth > 0) & (depth < 10_000)
        image = DepthImage(np.where(usable, depth, np.nan).astype(np.float32))
        return of_size(image, camera)

    images = RobotImages(
        origin=str(folder),
        names=list(found),
        camera=camera,
        read=read,
        track=PoseTrack.checked(poses, str(folder)),
        tool_from_camera=np.eye(4),
    )
    return images, key


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


def _value(file: Any, keys: tuple[str, ...]) -> Any:  # noqa: ANN401 - of h5py
    """Return what a file, or else the camera's state in it, has under the first of some keys."""
    for key in keys:
        if key in file:
            return np.asarray(file[key])
    try:
        state = json.loads(bytes(np.asarray(file[_STATE][()])).decode("utf-8"))
    except (KeyError, ValueError):
        return None
    state = state[0] if isinstance(state, list) and state else state
    return state.get(keys[0]) if isinstance(state, dict) else None


def _world_from_camera(path: Path) -> np.ndarray:
    with _opened(path) as file:
        pose = any_numbers(_value(file, _POSE_KEYS))
    if pose.shape != (4, 4):
        raise CalibrationDataError(
            f"{path}: no pose of the camera; expected one of {', '.join(_POSE_KEYS)} (4x4, "
            f"Blender's axes) or '{_STATE}'. Write it with the images, as "
            "bproc.camera.get_camera_pose(frame) gives it."
        )
    # Blender's camera looks along -z with y up; OpenCV's along z with y down.
    return pose @ np.diag([1.0, -1.0, -1.0, 1.0])
