"""Between ROS messages and arrays: depth in metres, amplitude, points."""

import sys
from array import array

import numpy as np
from sensor_msgs.msg import Image, PointCloud2, PointField
from std_msgs.msg import Header

# Encodings of one channel, and what a pixel is.
_TYPES = {
    "16UC1": np.uint16,
    "mono16": np.uint16,
    "8UC1": np.uint8,
    "mono8": np.uint8,
    "32FC1": np.float32,
}
# Metres per unit of a depth image (REP 118).
_METRES = {np.uint16: np.float32(1e-3), np.float32: np.float32(1.0)}


def depth_from_image(message: Image) -> np.ndarray:
    """Return depth, shape (H, W), float32, metres; NaN where there is no return.

    Raises:
        ValueError: The encoding is not one of a depth image, or the data do not fit the size.
    """
    pixels = _pixels(message)
    if pixels.dtype.type not in _METRES:
        raise ValueError(
            f"depth image of encoding '{message.encoding}': 16UC1 in millimetres or 32FC1 in "
            "metres is needed"
        )
    depth = pixels.astype(np.float32) * _METRES[pixels.dtype.type]
    return np.where(depth > 0, depth, np.float32(np.nan))


def amplitude_from_image(message: Image) -> np.ndarray:
    """Return amplitude, shape (H, W), float32, the camera's units.

    Raises:
        ValueError: The encoding has more than one channel, or the data do not fit the size.
    """
    return _pixels(message).astype(np.float32)


def image_from_depth(depth: np.ndarray, header: Header) -> Image:
    """Return a 32FC1 image of depth (H, W), metres, NaN where there is none."""
    message = Image(header=header, encoding="32FC1", is_bigendian=int(sys.byteorder == "big"))
    message.height, message.width = depth.shape
    message.step = 4 * message.width
    message.data = _bytes(depth)
    return message


def cloud_from_points(points: np.ndarray, header: Header) -> PointCloud2:
    """Return an organised cloud of points (H, W, 3), metres, NaN where there is none."""
    message = PointCloud2(header=header, is_bigendian=sys.byteorder == "big", is_dense=False)
    message.height, message.width = points.shape[:2]
    message.fields = [
        PointField(name=axis, offset=4 * k, datatype=PointField.FLOAT32, count=1)
        for k, axis in enumerate("xyz")
    ]
    message.point_step, message.row_step = 12, 12 * message.width
    message.data = _bytes(points)
    return message


def _pixels(message: Image) -> np.ndarray:
    """Return the image (H, W) in this machine's byte order, without the padding of its rows."""
    if message.encoding not in _TYPES:
        raise ValueError(
            f"image of encoding '{message.encoding}': one of {', '.join(_TYPES)} is needed"
        )
    kind = np.dtype(_TYPES[message.encoding])
    rows = np.frombuffer(message.data, np.uint8)
    used = message.width * kind.itemsize
    if message.step < used or rows.size != message.height * message.step:
        raise ValueError(
            f"image of {message.width}x{message.height} pixels, {message.step} bytes a row, with "
            f"{rows.size} bytes of data: its sizes contradict each other"
        )
    rows = rows.reshape(message.height, message.step)[:, :used]
    stored = kind.newbyteorder(">" if message.is_bigendian else "<")
    return np.ascontiguousarray(rows).view(stored).astype(kind)


def _bytes(values: np.ndarray) -> array:
    """Return what a message takes without looking at every byte."""
    return array("B", np.ascontiguousarray(values, np.float32).tobytes())
