"""Which topics of a bag hold images and camera, and what to say of those that do not."""

import numpy as np

from tofcorr.errors import CalibrationDataError
from tofcorr.importing.given_intrinsics import GivenIntrinsics
from tofcorr.importing.intrinsics_file import intrinsics_from_mapping
from tofcorr.importing.rosbag.bag import Bag
from tofcorr.importing.rosbag.image_message import COMPRESSED, IMAGE

CAMERA_INFO = "sensor_msgs/msg/CameraInfo"
_DEPTH_ENCODINGS = ("16UC1", "32FC1")
"""Encodings that depth has by ROS's convention (REP 118), and amplitude has not."""


def check_image_topics(bag: Bag, depth: str, amplitude: str | None) -> None:
    """Refuse topics that are missing, of another type, or exchanged.

    Raises:
        CalibrationDataError: As said; the message lists the topics.
    """
    for topic, option in ((depth, "--depth"), (amplitude, "--amplitude")):
        if topic is not None:
            _check(bag, topic, option, (IMAGE, COMPRESSED))
            if not bag.count(topic):
                raise CalibrationDataError(f"{bag.path}: {topic} has no message.")
    seen = _encoding(bag, depth)
    if not seen.startswith("mono"):
        return
    others = [topic for topic, kind in bag.types.items() if kind in (IMAGE, COMPRESSED)]
    for topic in others if amplitude is None else [amplitude]:
        beside = _encoding(bag, topic)
        if beside.startswith(_DEPTH_ENCODINGS):
            advice = f"name {topic} with --depth" if amplitude is None else "swap them"
            raise CalibrationDataError(
                f"{bag.path}: --depth {depth} is coded '{seen}', as amplitudes are, and {topic} "
                f"'{beside}', as depth is: {advice}."
            )


def camera_info_topic(bag: Bag, depth: str, given: str | None) -> str:
    """Return the topic of the depth camera's intrinsics.

    Args:
        bag: The bag.
        depth: The topic of depth images.
        given: What the user named; None: the `camera_info` beside the images, or the only one.

    Raises:
        CalibrationDataError: There is none, or it is not clear which.
    """
    if given is not None:
        _check(bag, given, "--camera-info", (CAMERA_INFO,))
        return given
    found = [topic for topic, kind in bag.types.items() if kind == CAMERA_INFO]
    space = depth
    while "/" in space:
        space = space.rpartition("/")[0]
        if f"{space}/camera_info" in found:
            return f"{space}/camera_info"
    if len(found) == 1:
        return found[0]
    many = f"several topics hold camera intrinsics: {', '.join(sorted(found))}"
    raise CalibrationDataError(
        f"{bag.path}: {many if found else 'no topic holds camera intrinsics (CameraInfo)'}. "
        "Name one with --camera-info, or a file with --intrinsics."
    )


def read_camera_info(bag: Bag, topic: str, depth: str) -> tuple[GivenIntrinsics, list[str]]:
    """Read the intrinsics of a topic, and what is to be said of them.

    By ROS's convention a topic `image_rect` is undistorted: then the matrix P holds.

    Raises:
        CalibrationDataError: There is no message, or its lens model is not supported.
    """
    message = next((message for _, message in bag.messages(topic)), None)
    if message is None:
        raise CalibrationDataError(f"{bag.path}: {topic} has no message.")
    # ROS 2 writes the names small, ROS 1 large.
    matrix, lens, projection = (
        np.ravel(getattr(message, name if hasattr(message, name) else name.upper()))
        for name in "kdp"
    )
    if not matrix.any():
        raise CalibrationDataError(
            f"{bag.path}: {topic} holds a matrix K of zeros: the driver knows no calibration. Name "
            "a file with --intrinsics."
        )
    values = {
        "K": [float(number) for number in matrix],
        "distortion": [float(number) for number in lens],
        "distortion_model": str(message.distortion_model) or "none",
        "width": int(message.width),
        "height": int(message.height),
    }
    warnings = []
    if "image_rect" in depth and any(values["distortion"]):
        rows = [float(number) for number in projection]
        values |= {"K": [*rows[:3], *rows[4:7], *rows[8:11]], "distortion": []}
        warnings.append(
            f"{depth} is undistorted by its name: the projection P of {topic} is used, without "
            "its distortion. State --intrinsics if that is wrong."
        )
    if not values["width"] or not values["height"]:
        del values["width"], values["height"]
    return intrinsics_from_mapping(values, f"{bag.path}: {topic}"), warnings


def _check(bag: Bag, topic: str, option: str, wanted: tuple[str, ...]) -> None:
    kind = bag.types.get(topic)
    if kind in wanted:
        return
    names = " or ".join(name.replace("/msg/", "/") for name in wanted)
    found = "there is no such topic" if kind is None else f"it is {kind.replace('/msg/', '/')}"
    raise CalibrationDataError(
        f"{bag.path}: {option} {topic}: expected {names}, {found}. The topics: "
        f"{bag.listed_topics()}."
    )


def _encoding(bag: Bag, topic: str) -> str:
    message = next((message for _, message in bag.messages(topic)), None)
    return str(getattr(message, "encoding", None) or getattr(message, "format", ""))
