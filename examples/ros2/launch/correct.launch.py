"""Start the corrector on the topics of a camera's driver.

ros2 launch tofcorr_ros correct.launch.py model:=run/corrector.ts depth:=/camera/depth/image_raw \
    infrared:=/camera/infra/image_raw camera_info:=/camera/depth/camera_info
"""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node

TOPICS = {
    "depth": "depth/image_raw",
    "infrared": "infrared/image_raw",
    "camera_info": "depth/camera_info",
    "corrected": "depth/image_corrected",
    "points": "points_corrected",
}


def generate_launch_description() -> LaunchDescription:
    """Return the arguments and the node."""
    arguments = [
        DeclareLaunchArgument("model", description="The corrector.ts of a run."),
        DeclareLaunchArgument("only_valid", default_value="false"),
        *(DeclareLaunchArgument(name, default_value=topic) for name, topic in TOPICS.items()),
    ]
    node = Node(
        package="tofcorr_ros",
        executable="depth_corrector",
        parameters=[{name: LaunchConfiguration(name) for name in ("model", "only_valid")}],
        remappings=[(topic, LaunchConfiguration(name)) for name, topic in TOPICS.items()],
        output="screen",
    )
    return LaunchDescription([*arguments, node])
