"""The camera's pose in the calibration files of easy_handeye (ROS 1) and easy_handeye2 (ROS 2)."""

from pathlib import Path
from typing import Any

from tofcorr.correction.corrector import DepthCorrector
from tofcorr.correction.export.pose import Mount
from tofcorr.correction.state import CalibrationState
from tofcorr.errors import ConfigError
from tofcorr.files import write_text
from tofcorr.options import dump_yaml

_KEYS = ("x", "y", "z", "qx", "qy", "qz", "qw")


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
        reference: The calibration.

    Raises:
        ConfigError: The ending is another, or the calibration has no estimated hand-eye transform.
        ExportError: The file cannot be written.
    """
    path = Path(path)
    if path.suffix not in (".yaml", ".calib"):
        raise ConfigError(f"{path}: expected .yaml (easy_handeye) or .calib (easy_handeye2).")
    mount = Mount(reference, "easy_handeye")
    frames, still = mount.frames, mount.frames.eye_to_hand
    base, effector = (frames.tool, frames.world) if still else (frames.world, frames.tool)
    parameters: dict[str, Any] = {
        "robot_base_frame": base,
        "robot_effector_frame": effector,
        "tracking_base_frame": frames.camera,
        # Both programs ask for the frame of a marker; a calibration from walls has none.
        "tracking_marker_frame": "tracking_marker",
        "move_group_namespace": "/",
        "move_group": "manipulator",
    }
    if path.suffix == ".yaml":
        parameters |= {"namespace": f"/{path.stem}/", "eye_on_hand": not still}
        values = zip(_KEYS, (*mount.translation, *mount.quaternion), strict=True)
        mapping = {"parameters": parameters, "transformation": dict(values)}
    else:
        kind = "eye_on_base" if still else "eye_in_hand"
        parameters |= {"name": path.stem, "calibration_type": kind}
        parameters |= {"freehand_robot_movement": True}
        mapping = {"parameters": parameters, "transform": mount.mapping()}
    write_text(path, mount.comment() + dump_yaml(mapping))
