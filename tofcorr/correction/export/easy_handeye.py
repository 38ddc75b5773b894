"""The camera's pose in the calibration files of easy_handeye (ROS 1) and easy_handeye2 (ROS 2)."""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from tofcorr.correction.corrector import DepthCorrector
from tofcorr.correction.export.mount import Mount, require_same, transform_of
from tofcorr.correction.state import CalibrationState
from tofcorr.errors import ConfigError
from tofcorr.files.staged import staged_file
from tofcorr.options import dump_yaml, read_yaml

# Both programs ask for the frame of a marker; a calibration from walls has none.
_NO_MARKER = "tracking_marker"


class _Layout(NamedTuple):
    """One program's file.

    Attributes:
        mapping: Gives the file's content for a pose and the calibration's name.
        read: Gives the transform (4, 4) that a content states.
    """

    mapping: Callable[[Mount, str], dict[str, Any]]
    read: Callable[[Mapping[str, Any]], np.ndarray]


def export_easy_handeye(
    corrector: DepthCorrector, path: Path | str, reference: CalibrationState
) -> None:
    """Write the transform as the program's own calibration would, for its publisher to load.

    The ending chooses the program, as each loads its own alone: `.yaml` is easy_handeye's, below
    `~/.ros/easy_handeye`; `.calib` is easy_handeye2's, below `~/.ros2/easy_handeye2/calibrations`.
    The file's name is the calibration's. A camera that stands still is `eye_on_base`.

    Args:
        corrector: The float32 runtime; not needed here.
        path: The file to write; an older one is replaced.
        reference: The calibration that the file must agree with.

    Raises:
        ConfigError: The ending is another, or the calibration has no estimated hand-eye transform.
        ExportError: What was written is not the transform, or the file cannot be written.
    """
    path = Path(path)
    if path.suffix not in _LAYOUTS:
        raise ConfigError(
            f"{path}: easy_handeye loads files that end in .yaml, easy_handeye2 files that end in "
            ".calib; choose one of the two endings."
        )
    layout = _LAYOUTS[path.suffix]
    mount = Mount.of(reference, "easy_handeye")
    comment = "".join(f"# {line}\n" for line in mount.in_words())
    with staged_file(path) as part:
        part.write_text(comment + dump_yaml(layout.mapping(mount, path.stem)), encoding="utf-8")
        require_same(path, layout.read(read_yaml(part)), mount)


def _frames(mount: Mount) -> dict[str, str]:
    """Return the names of base, effector, camera and marker."""
    frames = mount.frames
    base, effector = (frames.world, frames.tool)
    if frames.eye_to_hand:
        base, effector = effector, base
    return {
        "robot_base_frame": base,
        "robot_effector_frame": effector,
        "tracking_base_frame": frames.camera,
        "tracking_marker_frame": _NO_MARKER,
    }


def _easy_handeye(mount: Mount, name: str) -> dict[str, Any]:
    parameters = {
        "namespace": f"/{name}/",
        "move_group_namespace": "/",
        "move_group": "manipulator",
        "eye_on_hand": not mount.frames.eye_to_hand,
        **_frames(mount),
    }
    keys = ("x", "y", "z", "qx", "qy", "qz", "qw")
    values = (*mount.translation, *mount.quaternion)
    return {"parameters": parameters, "transformation": dict(zip(keys, values, strict=True))}


def _read_easy_handeye(values: Mapping[str, Any]) -> np.ndarray:
    found = values["transformation"]
    return transform_of(
        [found[key] for key in ("x", "y", "z")], [found[key] for key in ("qx", "qy", "qz", "qw")]
    )


def _easy_handeye2(mount: Mount, name: str) -> dict[str, Any]:
    parameters = {
        "name": name,
        "calibration_type": "eye_on_base" if mount.frames.eye_to_hand else "eye_in_hand",
        **_frames(mount),
        "freehand_robot_movement": True,
        "move_group_namespace": "/",
        "move_group": "manipulator",
    }
    translation = dict(zip("xyz", mount.translation, strict=True))
    rotation = dict(zip("xyzw", mount.quaternion, strict=True))
    return {
        "parameters": parameters,
        "transform": {"translation": translation, "rotation": rotation},
    }


def _read_easy_handeye2(values: Mapping[str, Any]) -> np.ndarray:
    found = values["transform"]
    return transform_of(
        [found["translation"][key] for key in "xyz"], [found["rotation"][key] for key in "xyzw"]
    )


_LAYOUTS = {
    ".yaml": _Layout(_easy_handeye, _read_easy_handeye),
    ".calib": _Layout(_easy_handeye2, _read_easy_handeye2),
}
