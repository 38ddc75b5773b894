"""Scenes in BOP's layout, whose poses are the camera's own."""

from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydantic import Field, NonNegativeInt, TypeAdapter

from tofcorr.errors import CalibrationDataError
from tofcorr.importing.frames.source import open_folder
from tofcorr.importing.images import DepthCoding
from tofcorr.importing.intrinsics import GivenIntrinsics, intrinsics_from_mapping
from tofcorr.importing.numbers import read_text
from tofcorr.importing.pose_track import PoseTrack
from tofcorr.importing.posed import import_posed
from tofcorr.importing.robot_images import PosedOptions
from tofcorr.options import Number, OpenOptions, PositiveNumber, Vector3, refused_in_words

_Nine = Annotated[tuple[Number, ...], Field(min_length=9, max_length=9)]


class _View(OpenOptions):
    """What `scene_camera.json` says of an image; other keys are ignored."""

    matrix: _Nine = Field(alias="cam_K")
    unit_mm: PositiveNumber = Field(alias="depth_scale")
    rotation: _Nine | None = Field(default=None, alias="cam_R_w2c")
    translation: Vector3 | None = Field(default=None, alias="cam_t_w2c")


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
    with refused_in_words(_View, str(path), CalibrationDataError):
        views = TypeAdapter(dict[NonNegativeInt, _View]).validate_json(read_text(path))
    lenses = {(view.matrix, view.unit_mm) for view in views.values()}
    if len(lenses) != 1:
        said = f"'cam_K' or 'depth_scale' of {len(views)} images differ"
        raise CalibrationDataError(f"{path}: expected images of one camera; {said}.")
    posed = {name: view for name, view in views.items() if view.rotation and view.translation}
    if not posed:
        raise CalibrationDataError(f"{path}: no image has a pose ('cam_R_w2c', 'cam_t_w2c').")
    poses = np.tile(np.eye(4), (len(posed), 1, 1))
    for pose, view in zip(poses, posed.values(), strict=True):
        # The pose is inverted; its translation is in millimetres.
        rotation = np.reshape(np.array(view.rotation), (3, 3)).T
        pose[:3, :3], pose[:3, 3] = rotation, -rotation @ np.array(view.translation) / 1000
    track = PoseTrack.checked(poses, str(path), names=[f"{name:06d}" for name in posed])
    ((matrix, unit_mm),) = lenses
    return intrinsics_from_mapping({"K": matrix}, str(path)), unit_mm, track
