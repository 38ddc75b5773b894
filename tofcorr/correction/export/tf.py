"""The camera's pose for ROS: a TransformStamped in YAML, and the commands that publish it."""

import shlex
from pathlib import Path

from tofcorr.correction.corrector import DepthCorrector
from tofcorr.correction.export.pose import Mount, decimals
from tofcorr.correction.state import CalibrationState
from tofcorr.files import write_text
from tofcorr.options import dump_yaml


def export_tf(corrector: DepthCorrector, path: Path | str, reference: CalibrationState) -> None:
    """Write the transform as geometry_msgs/TransformStamped, and the commands for ROS 2 and ROS 1.

    Args:
        corrector: The float32 runtime; not needed here.
        path: The file to write; an older one is replaced.
        reference: The calibration.

    Raises:
        ConfigError: The calibration has no estimated hand-eye transform.
        ExportError: The file cannot be written.
    """
    mount = Mount(reference, "tf")
    accuracy, names = mount.accuracy, mount.frames
    mapping = {
        "header": {"frame_id": names.tool},
        "child_frame_id": names.camera,
        "transform": mount.mapping(),
        "standard_errors": accuracy
        and {
            "translation_mm": list(accuracy.translation_se_mm),
            "rotation_deg": list(accuracy.rotation_se_deg),
            "undetermined": list(accuracy.undetermined),
        },
    }
    numbers = decimals([*mount.translation, *mount.quaternion])
    options = ("--x", "--y", "--z", "--qx", "--qy", "--qz", "--qw")
    words = [word for pair in zip(options, numbers, strict=True) for word in pair]
    words += ["--frame-id", names.tool, "--child-frame-id", names.camera]
    program = "tf2_ros static_transform_publisher"
    # As YAML that keeps each command on one line, to be copied.
    commands = (
        f"commands:\n  ros2: |-\n    ros2 run {program} {shlex.join(words)}\n"
        f"  ros1: |-\n    rosrun {program} {shlex.join([*numbers, names.tool, names.camera])}\n"
    )
    write_text(path, mount.comment() + dump_yaml(mapping) + commands)
