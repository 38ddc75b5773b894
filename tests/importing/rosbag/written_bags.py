"""What was recorded in a room, as ROS bags of all kinds."""

from pathlib import Path

import cv2
import numpy as np
from cameras import rigid
from importing.posed_scene import Recorded
from scipy.spatial.transform import Rotation

from tofcorr.examples.bags import BASE, DEPTH, INFO, TOOL, Bag, writing

KINDS = ("ros1", "sqlite3", "mcap")
ARM = rigid(Rotation.from_rotvec([0.0, 0.5, 0.2]), [0.02, 0.0, 0.11])
"""tool_from_wrist's inverse: the static last hop."""


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
        bag.images(recorded)
    return path


def write_compressed(bag: Bag, time: float, content: bytes, coding: str) -> None:
    """Write a sensor_msgs/CompressedImage of depth."""
    fields = {"format": coding, "data": np.frombuffer(content, np.uint8)}
    kind = "sensor_msgs/msg/CompressedImage"
    bag.write(DEPTH, kind, time + 0.02, header=bag.header(time), **fields)


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
