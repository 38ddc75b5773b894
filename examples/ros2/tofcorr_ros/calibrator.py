"""The calibrator: images and tf in, the next pose out, and a page that shows what is known.

Needs tofcorr. What it does stands in `calibrating`; here is only what ROS asks for.
"""

from typing import Any

import numpy as np
import rclpy
from geometry_msgs.msg import PoseStamped
from rclpy.node import Node
from rclpy.qos import qos_profile_sensor_data
from rclpy.time import Time
from scipy.spatial.transform import Rotation
from sensor_msgs.msg import CameraInfo, Image
from std_msgs.msg import String
from tf2_ros import Buffer, TransformException, TransformListener

from tofcorr.errors import TofcorrError
from tofcorr.geometry.camera import FrameNames
from tofcorr.live.watch import LivePage, serve
from tofcorr_ros.calibrating import Calibrating, Stops, intrinsics
from tofcorr_ros.messages import amplitude_from_image, depth_from_image
from tofcorr_ros.pairing import StampPairs

PARAMETERS = {
    "config": "ea",
    "depth_kind": "z",
    "wanted_mm": 0.5,
    "wanted_deg": 0.05,
    "folder": "",
    "model": "",
}
"""What `Calibrating` takes, and its defaults."""


class Calibrator(Node):
    """Takes an image wherever the robot stands still, and says where it should stand next.

    Parameters, besides `PARAMETERS`:
        base_frame, tool_frame: What tf calls the robot's base and its tool.
        infrared: Whether there are amplitudes.
        still_s: How long the tool must have stood still, seconds.
        still_within: Largest change of its pose meanwhile, metres or no unit.
        sync_tolerance_s: Largest difference of the stamps of depth and infrared, seconds.
        port: Of the page on this machine; 0: any free one.
    """

    def __init__(self) -> None:
        super().__init__("live_calibrator")

        def parameter(name: str, default: object) -> Any:  # noqa: ANN401
            return self.declare_parameter(name, default).value

        self.options = {name: parameter(name, default) for name, default in PARAMETERS.items()}
        self.base = parameter("base_frame", "base_link")
        self.tool = parameter("tool_frame", "tool0")
        self.infrared = parameter("infrared", True)
        self.stops = Stops(parameter("still_s", 1.0), parameter("still_within", 1e-4))
        self.pairs = StampPairs(parameter("sync_tolerance_s", 0.002))
        self.page = LivePage("the robot")
        self.server = serve(self.page, parameter("port", 8080))
        self.calibrating: Calibrating | None = None
        self.info: CameraInfo | None = None
        self.buffer = Buffer()
        self.listener = TransformListener(self.buffer, self)
        self.next_pose = self.create_publisher(PoseStamped, "next_pose", 1)
        self.known = self.create_publisher(String, "known", 1)
        qos = qos_profile_sensor_data
        self.create_subscription(CameraInfo, "depth/camera_info", self.on_camera_info, qos)
        self.create_subscription(Image, "depth/image_raw", self.on_depth, qos)
        if self.infrared:
            self.create_subscription(Image, "infrared/image_raw", self.on_infrared, qos)
        address = f"http://127.0.0.1:{self.server.server_port}/"
        self.get_logger().info(f"{address} shows what is known.")

    def on_camera_info(self, message: CameraInfo) -> None:
        """Keep the intrinsics."""
        self.info = message

    def on_depth(self, message: Image) -> None:
        """Take a depth image, or keep it until its infrared image comes."""
        self.take((message, None) if not self.infrared else self.pairs.add("depth", message))

    def on_infrared(self, message: Image) -> None:
        """Take the depth image of the same exposure, if it is there."""
        self.take(self.pairs.add("infrared", message))

    def take(self, pair: tuple[Image, Image | None] | None) -> None:
        """Learn from an image if the robot has stopped anew, and publish the next pose."""
        if pair is None or self.info is None:
            return
        depth, infrared = pair
        stamp = depth.header.stamp
        time = stamp.sec + 1e-9 * stamp.nanosec
        try:
            pose = self.transform(self.base, self.tool)
            if not self.stops.takes(time, pose):
                return
            if self.calibrating is None:
                self.calibrating = self.begin(depth.header.frame_id, self.info)
            light = None if infrared is None else amplitude_from_image(infrared)
            known = self.calibrating.take(depth_from_image(depth), light, pose, time)
        except (TofcorrError, TransformException, ValueError) as error:
            self.page.said.append(f"An image was left out: {error}")
            self.page.publish(self.calibrating and self.calibrating.live)
            self.get_logger().error(f"An image was left out: {error}")
            return
        self.known.publish(String(data=repr(known)))
        wanted = self.calibrating.live.next_pose()
        if wanted is not None:
            self.next_pose.publish(self.stamped(wanted, depth))

    def begin(self, camera: str, info: CameraInfo) -> Calibrating:
        """Begin the calibration; tf may hold where the camera roughly is on the tool."""
        try:
            guess = self.transform(self.tool, camera)
        except TransformException:
            guess = np.eye(4)
        return Calibrating(
            intrinsics(info.k, info.d, info.distortion_model, info.width, info.height),
            FrameNames(world=self.base, tool=self.tool, camera=camera or "camera"),
            tool_from_camera=guess,
            page=self.page,
            **self.options,
        )

    def transform(self, target: str, source: str) -> np.ndarray:
        """Return the newest pose of one frame in another, shape (4, 4)."""
        found = self.buffer.lookup_transform(target, source, Time()).transform
        move, turn = found.translation, found.rotation
        pose = np.eye(4)
        pose[:3, :3] = Rotation.from_quat([turn.x, turn.y, turn.z, turn.w]).as_matrix()
        pose[:3, 3] = move.x, move.y, move.z
        return pose

    def stamped(self, pose: np.ndarray, image: Image) -> PoseStamped:
        """Return a pose of the tool in the base as a message of the image's time."""
        message = PoseStamped()
        message.header.stamp, message.header.frame_id = image.header.stamp, self.base
        place, turn = message.pose.position, message.pose.orientation
        place.x, place.y, place.z = pose[:3, 3].tolist()
        turn.x, turn.y, turn.z, turn.w = Rotation.from_matrix(pose[:3, :3]).as_quat().tolist()
        return message


def main() -> None:
    """Run the node until it is stopped."""
    rclpy.init()
    node = Calibrator()
    try:
        rclpy.spin(node)
    except KeyboardInterrupt:
        pass
    finally:
        node.server.shutdown()
        node.destroy_node()
        rclpy.try_shutdown()
