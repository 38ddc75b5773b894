"""What a robot and a camera recorded, as a ROS bag: images, camera_info and tf."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from tofcorr.errors import CalibrationDataError
from tofcorr.examples.files import Recorded

DEPTH, INFRARED = "/camera/depth/image_raw", "/camera/infra/image_raw"
INFO = "/camera/depth/camera_info"
BASE, TOOL, CAMERA = "base_link", "tool0", "tof_optical_frame"
_TF_OF_ROS1 = "geometry_msgs/TransformStamped[] transforms"


class Bag:
    """A bag being written; of ROS 1 or not."""

    def __init__(self, writer: Any, store: Any, *, one: bool) -> None:  # noqa: ANN401 - of rosbags
        self.one, self._writer, self._store = one, writer, store
        self._connections: dict[str, Any] = {}

    def make(self, kind: str, **fields: Any) -> Any:  # noqa: ANN401
        """Make a message; fields of ROS 1 alone are filled in."""
        if self.one and kind == "std_msgs/msg/Header":
            fields["seq"] = 0
        return self._store.types[kind](**fields)

    def header(self, time: float, frame: str = CAMERA) -> Any:  # noqa: ANN401
        """Make a header."""
        seconds, rest = divmod(round(time * 10**6) * 1000, 10**9)
        stamp = self.make("builtin_interfaces/msg/Time", sec=seconds, nanosec=rest)
        return self.make("std_msgs/msg/Header", stamp=stamp, frame_id=frame)

    def write(self, topic: str, kind: str, received: float, **fields: Any) -> None:  # noqa: ANN401
        """Make a message, and write it."""
        if topic not in self._connections:
            connection = self._writer.add_connection(topic, kind, typestore=self._store)
            self._connections[topic] = connection
        serialize = self._store.serialize_ros1 if self.one else self._store.serialize_cdr
        content = serialize(self.make(kind, **fields), kind)
        self._writer.write(self._connections[topic], round(received * 10**9), content)

    def image(
        self,
        topic: str,
        time: float,
        pixels: np.ndarray,
        encoding: str,
        *,
        big_endian: bool = False,
        on_the_way: float = 0.02,
    ) -> None:
        """Write a sensor_msgs/Image, received so many seconds after it was taken."""
        content = pixels.astype(pixels.dtype.newbyteorder(">" if big_endian else "<")).tobytes()
        height, width = pixels.shape[:2]
        size = {"height": height, "width": width, "step": width * pixels.dtype.itemsize}
        self.write(
            topic,
            "sensor_msgs/msg/Image",
            time + on_the_way,
            header=self.header(time),
            **size,
            encoding=encoding,
            is_bigendian=int(big_endian),
            data=np.frombuffer(content, np.uint8),
        )

    def camera_info(
        self,
        topic: str,
        recorded: Recorded,
        model: str = "plumb_bob",
        size: tuple[int, int] | None = None,
    ) -> None:
        """Write a sensor_msgs/CameraInfo; a `size` stands in place of that of the images."""
        width, height = size or recorded.size
        roi = dict.fromkeys(("x_offset", "y_offset", "height", "width"), 0) | {"do_rectify": False}
        projection = np.concatenate([recorded.matrix, np.zeros((3, 1))], axis=1).ravel()
        values = {"k": recorded.matrix.ravel(), "r": np.eye(3).ravel(), "p": projection}
        values["d"] = np.array(recorded.distortion)
        if self.one:
            values = {name.upper(): value for name, value in values.items()}
        first = recorded.image_times[0]
        self.write(
            topic, "sensor_msgs/msg/CameraInfo", first, header=self.header(first),
            height=height, width=width, distortion_model=model, binning_x=0, binning_y=0,
            roi=self.make("sensor_msgs/msg/RegionOfInterest", **roi), **values,
        )  # fmt: skip

    def transform(self, topic: str, time: float, parent: str, child: str, pose: np.ndarray) -> None:
        """Write a tf2_msgs/TFMessage of one transform, parent_from_child, shape (4, 4)."""
        x, y, z, w = Rotation.from_matrix(pose[:3, :3]).as_quat()
        move = self.make("geometry_msgs/msg/Vector3", x=pose[0, 3], y=pose[1, 3], z=pose[2, 3])
        turn = self.make("geometry_msgs/msg/Quaternion", x=x, y=y, z=z, w=w)
        one = self.make(
            "geometry_msgs/msg/TransformStamped",
            header=self.header(time, parent),
            child_frame_id=child,
            transform=self.make("geometry_msgs/msg/Transform", translation=move, rotation=turn),
        )
        self.write(topic, "tf2_msgs/msg/TFMessage", time, transforms=[one])

    def images(self, recorded: Recorded) -> None:
        """Write depth as 16UC1, infrared as mono16."""
        every = zip(recorded.image_times, recorded.depth_mm, recorded.amplitude, strict=True)
        for time, depth, amplitude in every:
            self.image(DEPTH, time, depth, "16UC1")
            self.image(INFRARED, time, amplitude, "mono16")


@contextmanager
def writing(path: Path, kind: str) -> Iterator[Bag]:
    """Write a bag.

    Args:
        path: The file of ROS 1, or the folder of ROS 2; nothing may be there yet.
        kind: `ros1`; or of ROS 2 `mcap` or `sqlite3`.

    Raises:
        CalibrationDataError: The package `rosbags` is missing.
    """
    try:
        from rosbags import rosbag1, rosbag2
        from rosbags.typesys import Stores, get_types_from_msg, get_typestore
    except ImportError:
        raise CalibrationDataError(f"{path} needs rosbags: pip install 'tofcorr[rosbag]'") from None
    if kind == "ros1":
        store = get_typestore(Stores.ROS1_NOETIC)
        store.register(get_types_from_msg(_TF_OF_ROS1, "tf2_msgs/msg/TFMessage"))
        made: Any = rosbag1.Writer(path)
    else:
        store, plugin = get_typestore(Stores.ROS2_HUMBLE), rosbag2.StoragePlugin[kind.upper()]
        made = rosbag2.Writer(path, version=9, storage_plugin=plugin)
    with made as writer:
        yield Bag(writer, store, one=kind == "ros1")


def write_bag(recorded: Recorded, path: Path, kind: str = "mcap") -> None:
    """Write images, intrinsics and the tool's poses in the base; see `writing` for the rest."""
    with writing(path, kind) as bag:
        bag.camera_info(INFO, recorded)
        for time, pose in zip(recorded.pose_times, recorded.world_from_tool, strict=True):
            bag.transform("/tf", time, BASE, TOOL, pose)
        bag.images(recorded)
