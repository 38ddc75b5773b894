"""BOP's `scene_camera.json`: intrinsics, unit of depth and pose of each image."""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from tofcorr.errors import CalibrationDataError
from tofcorr.importing.given_intrinsics import GivenIntrinsics
from tofcorr.importing.intrinsics_file import intrinsics_from_mapping
from tofcorr.importing.poses.track import PoseTrack

FILE_NAME = "scene_camera.json"


@dataclass(frozen=True, kw_only=True, eq=False)
class SceneCamera:
    """What the file says of all images.

    Attributes:
        intrinsics: Of the one camera.
        unit_mm: Millimetres per count of depth (`depth_scale`).
        track: Poses of the camera in the world, named as the images are (`000012`).
    """

    intrinsics: GivenIntrinsics
    unit_mm: float
    track: PoseTrack


def read_scene_camera(path: Path) -> SceneCamera:
    """Read the file of one scene.

    Raises:
        CalibrationDataError: It cannot be read, images have different intrinsics or units, or there
            are no poses.
    """
    images = _read(path)
    source = str(path)
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
    poses = np.stack([_world_from_camera(i, f"{path}: image {n}") for n, i in posed.items()])
    (unit,) = _numbers(images[first], "depth_scale", 1, f"{path}: image {first}")
    if unit <= 0:
        raise CalibrationDataError(f"{path}: 'depth_scale' must be positive, got {unit:g}.")
    return SceneCamera(
        intrinsics=intrinsics_from_mapping(
            {"K": _numbers(images[first], "cam_K", 9, f"{path}: image {first}").tolist()}, source
        ),
        unit_mm=float(unit),
        track=PoseTrack.checked(poses, source, names=[f"{int(name):06d}" for name in posed]),
    )


def _world_from_camera(image: dict[str, Any], where: str) -> np.ndarray:
    """Invert the pose, whose translation is in millimetres."""
    rotation = _numbers(image, "cam_R_w2c", 9, where).reshape(3, 3)
    translation = 1e-3 * _numbers(image, "cam_t_w2c", 3, where)
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation.T, -rotation.T @ translation
    return pose


def _numbers(image: dict[str, Any], key: str, count: int, where: str) -> np.ndarray:
    try:
        values = np.asarray(image[key], dtype=np.float64).ravel()
    except (TypeError, ValueError, OverflowError):
        values = np.zeros(0)
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
            f"{path}: cannot be read ({error.strerror}); a BOP scene holds {FILE_NAME} and depth/."
        ) from None
    except (ValueError, RecursionError) as error:
        raise CalibrationDataError(f"{path}: not readable JSON ({error}).") from None
    whole = isinstance(content, dict) and bool(content)
    if not whole or not all(n.isdecimal() and isinstance(i, dict) for n, i in content.items()):
        raise CalibrationDataError(
            f"{path}: expected an object with one entry an image, by its number."
        )
    return content
