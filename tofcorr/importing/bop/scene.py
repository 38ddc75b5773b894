"""Scenes in BOP's layout, whose poses are the camera's own."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from tofcorr.errors import CalibrationDataError
from tofcorr.importing.frames.source import open_folder
from tofcorr.importing.images import DepthCoding
from tofcorr.importing.intrinsics import GivenIntrinsics, intrinsics_from_mapping
from tofcorr.importing.numbers import finite_numbers, read_text
from tofcorr.importing.pose_track import PoseTrack
from tofcorr.importing.posed import import_posed
from tofcorr.importing.robot_images import PosedOptions


def import_scene(
    scene: Path, out: Path, options: PosedOptions, amplitude: str | None = None
) -> dict[str, Any]:
    """Turn a scene in BOP's layout into a recording.

    Args:
        scene: The folder.
        out: The recording to write; it must not exist yet.
        options: How to choose images and look for walls.
        amplitude: Names of amplitude images; None: there are none.

    Raises:
        CalibrationDataError: The scene lacks something, such as poses; the message says what.
    """
    lens, unit_mm, track = read_scene_camera(scene / "scene_camera.json")
    coding = DepthCoding(unit_mm=unit_mm)
    source = open_folder(scene, "depth/*.png", lens, coding, track, amplitude_pattern=amplitude)
    return import_posed(replace(source, tool_from_camera=np.eye(4)), out, options)


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
        return finite_numbers(image.get(key), f"{path}: '{key}' of image {name}", (count,))

    images = _read(path)
    first = next(iter(images))
    for key in ("cam_K", "depth_scale"):
        one = images[first].get(key)
        other = next((n for n, i in images.items() if i.get(key) != one), None)
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
