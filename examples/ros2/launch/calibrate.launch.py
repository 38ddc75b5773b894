"""Start the calibrator and the corrector, which takes over each calibration that is enough.

ros2 launch tofcorr_ros calibrate.launch.py model:=/path/to/corrector.ts base_frame:=base_link \
    tool_frame:=tool0 depth:=/camera/depth/image_raw infrared:=/camera/infra/image_raw \
    camera_info:=/camera/depth/camera_info
"""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node

TOPICS = {
    "depth": "depth/image_raw",
    "infrared": "infrared/image_raw",
    "camera_info": "depth/camera_info",
    "next_pose": "next_pose",
    "known": "known",
}
DEFAULTS = {"base_frame": "base_link", "tool_frame": "tool0", "folder": "", "port": "8080"}


def generate_launch_description() -> LaunchDescription:
    """Return the arguments and the nodes."""
    arguments = [
        DeclareLaunchArgument("model", description="The corrector.ts to write and to use."),
        *(DeclareLaunchArgument(name, default_value=value) for name, value in DEFAULTS.items()),
        *(DeclareLaunchArgument(name, default_value=topic) for name, topic in TOPICS.items()),
    ]
    nodes = [
        Node(
            package="tofcorr_ros",
            executable=executable,
            parameters=[{name: LaunchConfiguration(name) for name in names}],
            remappings=[(topic, LaunchConfiguration(name)) for name, topic in TOPICS.items()],
            output="screen",
        )
        for executable, names in (
            ("live_calibrator", ("model", *DEFAULTS)),
            ("depth_corrector", ("model",)),
        )
    ]
    return LaunchDescription([*arguments, *nodes])
