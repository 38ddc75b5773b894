"""Images of ROS messages as arrays, in the numbers that they hold."""

from typing import Any

import cv2
import numpy as np

from tofcorr.importing.report import RefusedViewError

IMAGE = "sensor_msgs/msg/Image"
COMPRESSED = "sensor_msgs/msg/CompressedImage"

_TYPES = {
    "16UC1": np.uint16,
    "mono16": np.uint16,
    "32FC1": np.float32,
    "64FC1": np.float64,
    "32SC1": np.int32,
    "mono8": np.uint8,
    "8UC1": np.uint8,
}
"""Number type of each encoding of one channel."""

_DEPTH_HEADER = 12
"""Bytes before the PNG of compressedDepth: its format, and two numbers that code depth in floats
(image_transport_plugins, compressed_depth_image_transport)."""


def image_array(message: Any, topic: str) -> np.ndarray:  # noqa: ANN401 - of rosbags
    """Return a message of type Image or CompressedImage as an array, shape (H, W).

    Raises:
        RefusedViewError: It is damaged, has several channels, or is coded with losses.
    """
    if hasattr(message, "encoding"):
        return _plain(message, topic)
    return _compressed(str(message.format), bytes(message.data), topic)


def _plain(message: Any, topic: str) -> np.ndarray:  # noqa: ANN401 - of rosbags
    kind = _TYPES.get(message.encoding)
    if kind is None:
        raise RefusedViewError(
            f"{topic} has the encoding '{message.encoding[:40]}'; expected one channel: "
            f"{', '.join(_TYPES)}"
        )
    height, width, step = int(message.height), int(message.width), int(message.step)
    row = width * np.dtype(kind).itemsize
    if not height or not width or step < row or len(message.data) < height * step:
        raise RefusedViewError(
            f"{topic}: {len(message.data)} bytes do not hold {width}x{height} pixels of "
            f"{message.encoding} with {step} bytes a row"
        )
    content = np.asarray(message.data, dtype=np.uint8)[: height * step].reshape(height, step)
    order = ">" if message.is_bigendian else "<"
    image = np.ascontiguousarray(content[:, :row]).view(np.dtype(kind).newbyteorder(order))
    return image.astype(kind)


def _compressed(coding: str, content: bytes, topic: str) -> np.ndarray:
    if "compressedDepth" in coding:
        return _compressed_depth(coding, content, topic)
    if "jpeg" in coding or "jpg" in coding:
        raise RefusedViewError(
            f"{topic} holds JPEG images ('{coding[:60]}'): 8 bits a pixel, with losses. Record the "
            "raw topic, or compressedDepth"
        )
    return _png(content, topic)


def _compressed_depth(coding: str, content: bytes, topic: str) -> np.ndarray:
    """Undo compressed_depth_image_transport: PNG of counts, or of inverse depth for floats."""
    if "rvl" in coding.lower():
        raise RefusedViewError(
            f"{topic} is coded as RVL ('{coding[:60]}'); expected PNG. Republish it as raw"
        )
    image = _png(content[_DEPTH_HEADER:], topic)
    if not coding.strip().startswith("32FC1"):
        return image
    scale, shift = np.frombuffer(content[4:_DEPTH_HEADER], dtype="<f4").astype(np.float64)
    counts = image.astype(np.float64)
    with np.errstate(divide="ignore", invalid="ignore"):
        depth = np.where(counts > 0, scale / (counts - shift), np.nan)
    return depth.astype(np.float32)


def _png(content: bytes, topic: str) -> np.ndarray:
    try:
        image = cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_UNCHANGED)
    except cv2.error:
        image = None
    if image is None or image.ndim != 2:
        raise RefusedViewError(f"{topic}: a compressed image cannot be decoded to one channel")
    return image
