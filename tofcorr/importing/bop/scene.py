"""Scenes whose poses are the camera's own: BOP's layout, and BlenderProc's HDF5 files."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from tofcorr.data.recording import DepthKind
from tofcorr.errors import CalibrationDataError, ConfigError
from tofcorr.importing.frames.source import open_folder
from tofcorr.importing.images import DepthCoding, matching_files, opened_hdf5
from tofcorr.importing.intrinsics import (
    GivenIntrinsics,
    intrinsics_from_mapping,
    read_named_intrinsics,
)
from tofcorr.importing.numbers import any_numbers, finite_numbers, read_text
from tofcorr.importing.pose_track import PoseTrack
from tofcorr.importing.posed import import_posed
from tofcorr.importing.robot_images import PosedOptions, RobotImages

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
) -> dict[str, Any]:
    """Turn a scene in BOP's layout, or a folder of HDF5 files, into a recording.

    Args:
        scene: The folder.
        out: The recording to write; it must not exist yet.
        options: How to choose images and look for walls.
        amplitude: Names of amplitude images; BOP alone.
        intrinsics: A file or a shipped name; HDF5 alone.

    Raises:
        CalibrationDataError: The scene lacks something, such as poses; the message says what.
        ConfigError: An option belongs to the other layout.
    """
    path = scene / _FILE_NAME
    if not path.exists() and any(scene.glob("*.hdf5")):
        if amplitude is not None:
            raise ConfigError("--amplitude is for BOP's layout; HDF5 scenes have no amplitudes.")
        given = None if intrinsics is None else read_named_intrinsics(intrinsics)
        source, kind = _open_hdf5(scene, given)
        options = options.model_copy(update={"depth_kind": kind})
    else:
        if intrinsics is not None:
            raise ConfigError(f"--intrinsics is for HDF5; a BOP scene states them in {_FILE_NAME}.")
        lens, unit_mm, track = read_scene_camera(path)
        coding = DepthCoding(unit_mm=unit_mm)
        source = open_folder(scene, "depth/*.png", lens, coding, track, amplitude_pattern=amplitude)
    source = replace(source, tool_from_camera=np.eye(4))
    return import_posed(source, out, options)


def read_scene_camera(path: Path) -> tuple[GivenIntrinsics, float, PoseTrack]:
    """Read BOP's `scene_camera.json`.

    Returns:
        The intrinsics of the one camera; millimetres per count of depth (`depth_scale`); and the
        poses of the camera in the world, named as the images are (`000012`).

    Raises:
        CalibrationDataError: It cannot be read, images have different intrinsics or units, or there
            are no poses.
    """

    def numbers(name: str, image: dict[str, Any], key: str, count: int) -> np.ndarray:
        return finite_numbers(image[key], f"{path}: '{key}' of image {name}", (count,))

    images = _read(path)
    first = next(iter(images))
    for key in ("cam_K", "depth_scale"):
        lacking = next((name for name, image in images.items() if key not in image), None)
        if lacking is not None:
            raise CalibrationDataError(f"{path}: image {lacking} has no '{key}'.")
        other = next((n for n, i in images.items() if i[key] != images[first][key]), None)
        if other is not None:
            raise CalibrationDataError(f"{path}: '{key}' of images {first} and {other} differ.")
    posed = {n: i for n, i in images.items() if "cam_R_w2c" in i and "cam_t_w2c" in i}
    if not posed:
        raise CalibrationDataError(f"{path}: no image has a pose ('cam_R_w2c', 'cam_t_w2c').")
    poses = np.tile(np.eye(4), (len(posed), 1, 1))
    for pose, (name, image) in zip(poses, posed.items(), strict=True):
        # The pose is inverted; its translation is in millimetres.
        rotation = numbers(name, image, "cam_R_w2c", 9).reshape(3, 3).T
        translation = numbers(name, image, "cam_t_w2c", 3) / 1000
        pose[:3, :3], pose[:3, 3] = rotation, -rotation @ translation
    (unit,) = numbers(first, images[first], "depth_scale", 1)
    if unit <= 0:
        raise CalibrationDataError(f"{path}: 'depth_scale' must be positive, got {unit:g}.")
    matrix = numbers(first, images[first], "cam_K", 9).tolist()
    track = PoseTrack.checked(poses, str(path), names=[f"{int(name):06d}" for name in posed])
    return intrinsics_from_mapping({"K": matrix}, str(path)), float(unit), track


def _read(path: Path) -> dict[str, dict[str, Any]]:
    text = read_text(path)
    try:
        content = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise CalibrationDataError(f"{path}: not readable JSON ({error}).") from None
    whole = isinstance(content, dict) and bool(content)
    if not whole or not all(n.isdecimal() and isinstance(i, dict) for n, i in content.items()):
        raise CalibrationDataError(f"{path}: expected an object with one entry an image number.")
    return content


def _open_hdf5(folder: Path, intrinsics: GivenIntrinsics | None) -> tuple[RobotImages, DepthKind]:
    """Open a folder of BlenderProc's files `0.hdf5`, `1.hdf5`, ..., one an image.

    Args:
        folder: The folder.
        intrinsics: The camera's; None: as in the files.

    Returns:
        Images and poses; and what depth means: `depth` along the optical axis, `distance` along the
        ray.

    Raises:
        CalibrationDataError: A file is damaged, or has no depth, pose or intrinsics; or the package
            h5py is missing.
    """
    paths = list(matching_files(folder, "*.hdf5", "HDF5").values())
    with opened_hdf5(paths[0]) as file:
        keys, matrix = list(file), _value(file, ("cam_K", "K"))
    if not {"depth", "distance"} & {*keys}:
        held = ", ".join(keys) or "nothing"
        raise CalibrationDataError(f"{paths[0]}: expected 'depth' or 'distance', found {held}.")
    if intrinsics is None:
        if matrix is None:
            raise CalibrationDataError(f"{paths[0]}: no 'cam_K'; name --intrinsics FILE.")
        values = {"K": np.asarray(matrix).tolist()}
        intrinsics = intrinsics_from_mapping(values, str(paths[0]))
    track = PoseTrack.checked(np.stack([_world_from_camera(p) for p in paths]), str(folder))
    coding = DepthCoding(unit_mm=1000)
    images = open_folder(folder, "*.hdf5", intrinsics, coding, track)
    return images, "z" if "depth" in keys else "radial"


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
    with opened_hdf5(path) as file:
        pose = any_numbers(_value(file, _POSE_KEYS))
    if pose.shape != (4, 4):
        keys = ", ".join((*_POSE_KEYS, _STATE))
        raise CalibrationDataError(f"{path}: no pose of the camera (4x4); expected one of {keys}.")
    # Blender's camera looks along -z with y up; OpenCV's along z with y down.
    return pose @ np.diag([1.0, -1.0, -1.0, 1.0])
