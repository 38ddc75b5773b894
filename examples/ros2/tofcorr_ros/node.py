"""The node: depth and infrared images in, corrected depth and points out.

Needs rclpy, NumPy and torch; tofcorr itself is not needed on the robot.
"""

import json
from pathlib import Path
from typing import Any

import numpy as np
import rclpy
import torch
from rclpy.node import Node
from rclpy.qos import qos_profile_sensor_data
from sensor_msgs.msg import CameraInfo, Image, PointCloud2

from tofcorr_ros.messages import (
    amplitude_from_image,
    cloud_from_points,
    depth_from_image,
    image_from_depth,
)
from tofcorr_ros.pairing import StampPairs

# Depth images without an infrared partner, from which on something is said: a second at 30 Hz.
_PATIENCE = 30
# Largest relative difference of the focal lengths and centres that is not remarked upon. A
# focal length 0.1 % off moves a point at the image's edge by 1 mm at 2 m.
_LENS_TOLERANCE = 1e-3
# How often the file of the model is looked at, seconds.
_LOOK_S = 1.0


class DepthCorrector(Node):
    """Corrects the depth images of one camera.

    Parameters:
        model: The `corrector.ts` of a run. When it is replaced by another one, that one is used
            from then on.
        only_valid: Whether pixels outside the calibrated range become NaN; otherwise they are
            corrected with the error at the range's edge.
        sync_tolerance_s: Largest difference of the stamps of depth and infrared, seconds.
    """

    def __init__(self) -> None:
        super().__init__("depth_corrector")
        self.only_valid = self.declare_parameter("only_valid", False).value
        self.pairs = StampPairs(self.declare_parameter("sync_tolerance_s", 0.002).value)
        self.model = self.declare_parameter("model", "").value
        self.written: tuple[int, int] | None = None
        self.corrector: Any = None
        self.camera: dict[str, Any] = {}
        self.hears_infrared = False
        self.unpaired = 0
        self.said: set[str] = set()
        self.depth = self.create_publisher(Image, "depth/image_corrected", 10)
        self.cloud = self.create_publisher(PointCloud2, "points_corrected", 10)
        qos = qos_profile_sensor_data
        self.create_subscription(CameraInfo, "depth/camera_info", self.on_camera_info, qos)
        self.create_subscription(Image, "depth/image_raw", self.on_depth, qos)
        self.load()
        self.create_timer(_LOOK_S, self.load)

    def load(self) -> None:
        """Use the model that is in the file now; keep the one before where that cannot be read."""
        try:
            status = Path(self.model).stat()
            if (status.st_mtime_ns, status.st_ino) == self.written:
                return
            self.written = status.st_mtime_ns, status.st_ino
            corrector = torch.jit.load(self.model)
            camera = json.loads(corrector.metadata())
        except (OSError, RuntimeError, ValueError) as error:
            reason = str(error).splitlines()[0]
            self.say_once(f"model {self.written}", f"No new model in '{self.model}': {reason}")
            return
        self.corrector, self.camera = corrector, camera
        if camera["needs_amplitude"] and not self.hears_infrared:
            qos = qos_profile_sensor_data
            self.create_subscription(Image, "infrared/image_raw", self.on_infrared, qos)
            self.hears_infrared = True
        size = camera["camera"]
        self.get_logger().info(
            f"Model {camera['model']} for {size['width']}x{size['height']} pixels, "
            f"{camera['depth_kind']} depth."
        )

    def on_depth(self, message: Image) -> None:
        """Correct a depth image, or keep it until its infrared image comes."""
        if self.corrector is None:
            return
        if not self.camera["needs_amplitude"]:
            self.correct(message, None)
            return
        self.unpaired += 1
        if self.unpaired >= _PATIENCE:
            self.say_once(
                "infrared",
                f"{self.unpaired} depth images and no infrared image of the same time: the model "
                f"{self.camera['model']} needs it. Is 'infrared/image_raw' remapped to the "
                "camera's infrared topic, and are the stamps equal (sync_tolerance_s)?",
            )
        self.correct_pair(self.pairs.add("depth", message))

    def on_infrared(self, message: Image) -> None:
        """Correct the depth image of the same exposure, if it is there."""
        self.correct_pair(self.pairs.add("infrared", message))

    def on_camera_info(self, message: CameraInfo) -> None:
        """Remark upon another lens calibration than the model was trained with."""
        if self.corrector is None:
            return
        known = np.array(self.camera["camera"]["K"]).ravel()
        found = np.array(message.k)
        if np.abs(found - known).max() > _LENS_TOLERANCE * known[0]:
            self.say_once(
                "lens",
                f"camera_info has fx fy cx cy {found[[0, 4, 2, 5]].round(2).tolist()}, the model "
                f"was trained with {known[[0, 4, 2, 5]].round(2).tolist()}: the correction holds "
                "only for the same camera and lens calibration.",
            )

    def correct_pair(self, pair: tuple[Image, Image] | None) -> None:
        """Correct depth and infrared of one exposure."""
        if pair is not None:
            self.unpaired = 0
            self.correct(*pair)

    def correct(self, depth_message: Image, infrared_message: Image | None) -> None:
        """Publish corrected depth, and points if somebody listens."""
        try:
            depth = self.checked("depth", depth_from_image(depth_message))
            amplitude = np.full_like(depth, np.nan)
            if infrared_message is not None:
                amplitude = self.checked("infrared", amplitude_from_image(infrared_message))
        except ValueError as error:
            self.say_once("images", f"Not corrected: {error}.")
            return
        given = torch.from_numpy(depth), torch.from_numpy(amplitude)
        with torch.inference_mode():
            corrected, valid = self.corrector(*given)
            hidden = ~valid if self.only_valid else torch.zeros_like(valid)
            corrected[hidden] = torch.nan
            self.depth.publish(image_from_depth(corrected.numpy(), depth_message.header))
            if self.cloud.get_subscription_count() > 0:
                points = self.corrector.points(*given)
                points[hidden] = torch.nan
                self.cloud.publish(cloud_from_points(points.numpy(), depth_message.header))

    def checked(self, name: str, image: np.ndarray) -> np.ndarray:
        """Return the image if it has the size that the model was trained for."""
        size = self.camera["camera"]
        if image.shape != (size["height"], size["width"]):
            raise ValueError(
                f"the {name} image has {image.shape[1]}x{image.shape[0]} pixels, the model "
                f"{self.camera['model']} is for {size['width']}x{size['height']}; use the "
                "camera's mode of the training, unrectified and uncropped"
            )
        return image

    def say_once(self, about: str, message: str) -> None:
        """Log an error, once however often it happens."""
        if about not in self.said:
            self.said.add(about)
            self.get_logger().error(message)


def main() -> None:
    """Run the node until it is stopped."""
    rclpy.init()
    node = DepthCorrector()
    try:
        rclpy.spin(node)
    except KeyboardInterrupt:
        pass
    finally:
        node.destroy_node()
        rclpy.try_shutdown()
