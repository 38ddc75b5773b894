"""The camera's pose for ROS: a TransformStamped in YAML, and the commands that publish it."""

import shlex
from pathlib import Path
from typing import Any

from tofcorr.correction.corrector import DepthCorrector
from tofcorr.correction.export.mount import Mount, decimals, require_same, transform_of
from tofcorr.correction.state import CalibrationState
from tofcorr.files.staged import staged_file
from tofcorr.options import dump_yaml, read_yaml


def export_tf(corrector: DepthCorrector, path: Path | str, reference: CalibrationState) -> None:
    """Write the transform as geometry_msgs/TransformStamped, and the commands for ROS 2 and ROS 1.

    Args:
        corrector: The float32 runtime; not needed here.
        path: The file to write; an older one is replaced.
        reference: The calibration that the file must agree with.

    Raises:
        ConfigError: The calibration has no estimated hand-eye transform.
        ExportError: What was written is not the transform, or the file cannot be written.
    """
    mount = Mount.of(reference, "tf")
    comment = "".join(f"# {line}\n" for line in mount.in_words())
    with staged_file(path) as part:
        part.write_text(comment + dump_yaml(_mapping(mount)) + _commands(mount), encoding="utf-8")
        written = read_yaml(part)["transform"]
        found = transform_of(
            [written["translation"][axis] for axis in "xyz"],
            [written["rotation"][axis] for axis in "xyzw"],
        )
        require_same(path, found, mount)


def _mapping(mount: Mount) -> dict[str, Any]:
    accuracy = mount.accuracy
    return {
        "header": {"frame_id": mount.frames.tool},
        "child_frame_id": mount.frames.camera,
        "transform": {
            "translation": dict(zip("xyz", mount.translation, strict=True)),
            "rotation": dict(zip("xyzw", mount.quaternion, strict=True)),
        },
        "standard_errors": None
        if accuracy is None
        else {
            "translation_mm": list(accuracy.translation_se_mm),
            "rotation_deg": list(accuracy.rotation_se_deg),
            "undetermined": list(accuracy.undetermined),
        },
    }


def _commands(mount: Mount) -> str:
    """Return the commands as YAML that keeps each on one line, to be copied."""
    return f"commands:\n  ros2: |-\n    {_ros2(mount)}\n  ros1: |-\n    {_ros1(mount)}\n"


def _ros2(mount: Mount) -> str:
    numbers = decimals([*mount.translation, *mount.quaternion])
    options = ("--x", "--y", "--z", "--qx", "--qy", "--qz", "--qw")
    words = [word for pair in zip(options, numbers, strict=True) for word in pair]
    words += ["--frame-id", mount.frames.tool, "--child-frame-id", mount.frames.camera]
    return f"ros2 run tf2_ros static_transform_publisher {shlex.join(words)}"


def _ros1(mount: Mount) -> str:
    numbers = decimals([*mount.translation, *mount.quaternion])
    words = [*numbers, mount.frames.tool, mount.frames.camera]
    return f"rosrun tf2_ros static_transform_publisher {shlex.join(words)}"
