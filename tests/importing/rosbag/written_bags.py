"""What was recorded in a room, as ROS bags of all kinds."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from cameras import rigid
from importing.posed_scene import Recorded
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from scipy.spatial.transform import Rotation

KINDS = ("ros1", "sqlite3", "mcap")
DEPTH, INFRARED = "/camera/depth/image_raw", "/camera/ir/image_raw"
INFO = "/camera/depth/camera_info"
TF_MESSAGE = "geometry_msgs/TransformStamped[] transforms"
BASE, TOOL, CAMERA = "base_link", "tool0", "tof_optical"

ARM = rigid(Rotation.from_rotvec([0.0, 0.5, 0.2]), [0.02, 0.0, 0.11])
"""tool_from_wrist's inverse: the static last hop."""


class Bag:
    """A bag being written; of ROS 1 or not."""

    def __init__(self, writer: Any, store: Any, *, one: bool) -> None:
        self.one, self._writer, self._store = one, writer, store
        self._connections: dict[str, Any] = {}

    def make(self, kind: str, **fields: Any) -> Any:
        """Make a message; fields of ROS 1 alone are filled in."""
        made = self._store.types[kind]
        if self.one and kind == "std_msgs/msg/Header":
            fields["seq"] = 0
        return made(**fields)

    def header(self, time: float, frame: str = CAMERA) -> Any:
        """Make a header."""
        seconds, rest = divmod(round(time * 1e6) * 1000, 10**9)
        stamp = self.make("builtin_interfaces/msg/Time", sec=seconds, nanosec=rest)
        return self.make("std_msgs/msg/Header", stamp=stamp, frame_id=frame)

    def write(self, topic: str, kind: str, received: float, **fields: Any) -> None:
        """Make a message, and write it."""
        if topic not in self._connections:
            connection = self._writer.add_connection(topic, kind, typestore=self._store)
            self._connections[topic] = connection
        serialize = self._store.serialize_ros1 if self.one else self._store.serialize_cdr
        content = serialize(self.make(kind, **fields), kind)
        self._writer.write(self._connections[topic], round(received * 1e9), content)

    def image(
        self, topic: str, time: float, pixels: np.ndarray, encoding: str, big_endian: bool = False
    ) -> None:
        """Write a sensor_msgs/Image."""
        order = ">" if big_endian else "<"
        content = pixels.astype(pixels.dtype.newbyteorder(order)).tobytes()
        height, width = pixels.shape[:2]
        size = {"height": height, "width": width, "step": width * pixels.dtype.itemsize}
        self.write(
            topic,
            "sensor_msgs/msg/Image",
            time + 0.02,
            header=self.header(time),
            **size,
            encoding=encoding,
            is_bigendian=int(big_endian),
            data=np.frombuffer(content, np.uint8),
        )

    def compressed(self, topic: str, time: float, content: bytes, coding: str) -> None:
        """Write a sensor_msgs/CompressedImage."""
        fields = {"format": coding, "data": np.frombuffer(content, np.uint8)}
        kind = "sensor_msgs/msg/CompressedImage"
        self.write(topic, kind, time + 0.02, header=self.header(time), **fields)

    def camera_info(
        self,
        topic: str,
        recorded: Recorded,
        model: str = "plumb_bob",
        size: tuple[int, int] | None = None,
    ) -> None:
        """Write a sensor_msgs/CameraInfo."""
        width, height = size or recorded.size
        projection = np.concatenate([recorded.matrix, np.zeros((3, 1))], axis=1).ravel()
        roi = self.make(
            "sensor_msgs/msg/RegionOfInterest",
            x_offset=0, y_offset=0, height=0, width=0, do_rectify=False,
        )  # fmt: skip
        values = {"k": recorded.matrix.ravel(), "r": np.eye(3).ravel(), "p": projection}
        values["d"] = np.array(recorded.distortion)
        if self.one:
            values = {name.upper(): value for name, value in values.items()}
        first = recorded.image_times[0]
        self.write(
            topic, "sensor_msgs/msg/CameraInfo", first, header=self.header(first),
            height=height, width=width, distortion_model=model, binning_x=0, binning_y=0, roi=roi,
            **values,
        )  # fmt: skip

    def transform(self, topic: str, time: float, parent: str, child: str, pose: np.ndarray) -> None:
        """Write a tf2_msgs/TFMessage of one transform."""
        x, y, z, w = Rotation.from_matrix(pose[:3, :3]).as_quat()
        move = self.make("geometry_msgs/msg/Vector3", x=pose[0, 3], y=pose[1, 3], z=pose[2, 3])
        turn = self.make("geometry_msgs/msg/Quaternion", x=x, y=y, z=z, w=w)
        one = self.make(
            "geometry_msgs/msg/TransformStamped",
            header=self.header(time, parent),
            child_frame_id=child,
            transform=self.make("geometry_msgs/msg/Transform", translation=move, rotation=turn),
        )
        self.write(topic, "tf2_msgs/msg/TFMessage", time + 0.004, transforms=[one])


@contextmanager
def writing(path: Path, kind: str) -> Iterator[Bag]:
    """Open a bag of one of `KINDS`."""
    if kind == "ros1":
        with Writer1(path) as writer:
            store = get_typestore(Stores.ROS1_NOETIC)
            store.register(get_types_from_msg(TF_MESSAGE, "tf2_msgs/msg/TFMessage"))
            yield Bag(writer, store, one=True)
        return
    plugin = StoragePlugin.MCAP if kind == "mcap" else StoragePlugin.SQLITE3
    with Writer2(path, version=9, storage_plugin=plugin) as writer:
        yield Bag(writer, get_typestore(Stores.ROS2_HUMBLE), one=False)


def bag_path(folder: Path, kind: str) -> Path:
    """Return where a bag of a kind is written: a file for ROS 1, else a folder."""
    return folder / ("drive.bag" if kind == "ros1" else "drive")


def write_robot(bag: Bag, recorded: Recorded) -> None:
    """Write the tool's poses in the base over three hops, two moving and one static."""
    first = recorded.pose_times[0]
    bag.transform("/tf_static", first, "world", BASE, np.diag([-1.0, -1.0, 1.0, 1.0]))
    bag.transform("/tf_static", first, "wrist", TOOL, ARM)
    for time, pose in zip(recorded.pose_times, recorded.world_from_tool, strict=True):
        turn = np.arctan2(pose[1, 3], pose[0, 3] + 3.0)
        shoulder = rigid(Rotation.from_rotvec([0.0, 0.0, turn]), [0.0, 0.0, 0.4])
        wrist = np.linalg.inv(shoulder) @ pose @ np.linalg.inv(ARM)
        bag.transform("/tf", time, BASE, "shoulder", shoulder)
        bag.transform("/tf", time, "shoulder", "wrist", wrist)


def write_drive(recorded: Recorded, folder: Path, kind: str) -> Path:
    """Write a whole drive: 16UC1 depth, mono16 infrared, plumb_bob, tf over three hops."""
    folder.mkdir(parents=True, exist_ok=True)
    path = bag_path(folder, kind)
    with writing(path, kind) as bag:
        bag.camera_info(INFO, recorded)
        write_robot(bag, recorded)
        images = zip(recorded.image_times, recorded.depth_mm, recorded.amplitude, strict=True)
        for time, depth, amplitude in images:
            bag.image(DEPTH, time, depth, "16UC1")
            bag.image(INFRARED, time, amplitude, "mono16")
    return path


def compressed_depth(counts: np.ndarray, *, floats: bool = False) -> bytes:
    """Code depth as compressed_depth_image_transport does: a header and a PNG."""
    header = np.zeros(3, dtype="<f4")
    if floats:
        # Inverse depth: counts = A / depth + B, exact to 0.1 mm at 2 m.
        scale = np.float32(100.0 * 101.0)
        shift = np.float32(1.0 - scale / 10.0)
        header[1:] = scale, shift
        depth = counts / 1e3
        with np.errstate(divide="ignore"):
            counts = np.where(counts > 0, np.round(scale / depth + shift), 0).astype(np.uint16)
    return header.tobytes() + cv2.imencode(".png", counts)[1].tobytes()
