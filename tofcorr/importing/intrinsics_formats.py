"""Intrinsics as other programs nest and name them, in the keys that `intrinsics_file` reads."""

import reprlib
from collections.abc import Mapping
from typing import Any

import numpy as np

from tofcorr.errors import CalibrationDataError
from tofcorr.options.messages import one_line
from tofcorr.options.numbers import LARGEST_NUMBER

_AZURE_MODES = {
    (640, 576): ((1024, 1024), (192, 180)),
    (320, 288): ((512, 512), (96, 90)),
    (1024, 1024): ((1024, 1024), (0, 0)),
    (512, 512): ((512, 512), (0, 0)),
}
"""Size of the depth images, the size the sensor is binned to, and where the image is cut out of it,
pixels. From the Azure-Kinect-Sensor-SDK, mode_specific_calibration.c."""


def numbers_in(value: Any, source: str, what: str) -> list[float]:  # noqa: ANN401 - from a file
    """Flatten a list, a list of lists or a ROS matrix (rows, cols, data).

    Args:
        value: What the file holds.
        source: Where it comes from, for messages.
        what: What it should be, for messages.

    Raises:
        CalibrationDataError: It holds something else than finite numbers.
    """
    if isinstance(value, Mapping):
        value = value.get("data", [])
    shown = one_line(reprlib.repr(value))
    try:
        array = np.asarray(value, dtype=np.float64).ravel()
    except (TypeError, ValueError, OverflowError):
        raise CalibrationDataError(f"{source}: {what} must be numbers, got {shown}.") from None
    if not np.isfinite(array).all() or np.asarray(value).dtype == bool:
        raise CalibrationDataError(f"{source}: {what} must be finite numbers, got {shown}.")
    if array.size and np.abs(array).max() > LARGEST_NUMBER:
        raise CalibrationDataError(
            f"{source}: {what} must be at most {LARGEST_NUMBER:g}, got {shown}."
        )
    return array.tolist()


def understood(values: Mapping[str, Any], source: str, camera: str | None) -> Mapping[str, Any]:
    """Return the keys and values of one camera in the names of `recording.yaml`.

    Args:
        values: The whole file.
        source: Where it comes from, for messages.
        camera: Which of several cameras; None: the only one.

    Raises:
        CalibrationDataError: There are several cameras, or the lens model is not supported.
    """
    for read in (_kalibr, _azure_kinect, _bop):
        found = read(values, source, camera)
        if found is not None:
            return found
    return values["camera"] if isinstance(values.get("camera"), Mapping) else values


def _kalibr(values: Mapping[str, Any], source: str, camera: str | None) -> dict[str, Any] | None:
    """Read one camera of Kalibr's camchain: pinhole with radtan, which is OpenCV's model."""
    cameras = {
        name: entry
        for name, entry in values.items()
        if isinstance(entry, Mapping) and "camera_model" in entry and "intrinsics" in entry
    }
    if not cameras:
        return None
    entry = cameras[_chosen(cameras, source, camera)]
    model = str(entry["camera_model"])
    if model != "pinhole":
        raise CalibrationDataError(
            f"{source}: Kalibr's camera model '{one_line(model)}' is not supported; calibrate with "
            "pinhole-radtan."
        )
    lens = str(entry.get("distortion_model", "none"))
    if lens not in ("radtan", "none"):
        raise CalibrationDataError(
            f"{source}: Kalibr's distortion model '{one_line(lens)}' is not supported; calibrate "
            "with pinhole-radtan."
        )
    numbers = numbers_in(entry["intrinsics"], source, "Kalibr's 'intrinsics'")
    if len(numbers) != 4:
        raise CalibrationDataError(
            f"{source}: Kalibr's 'intrinsics' must be fx, fy, cx, cy, got {len(numbers)} numbers."
        )
    found: dict[str, Any] = dict(zip(("fx", "fy", "cx", "cy"), numbers, strict=True))
    size = entry.get("resolution")
    if isinstance(size, list) and len(size) == 2:
        found |= {"width": size[0], "height": size[1]}
    return found | {"distortion": entry.get("distortion_coeffs", [])}


def _azure_kinect(
    values: Mapping[str, Any], source: str, camera: str | None
) -> dict[str, Any] | None:
    """Read the depth camera of an Azure Kinect's calibration (`k4a_device_get_raw_calibration`).

    Its numbers are shares of the sensor of 1024 x 1024 pixels, counted from the pixel's corner.
    """
    information = values.get("CalibrationInformation")
    if not isinstance(information, Mapping):
        return None
    wanted = camera or "CALIBRATION_CameraPurposeDepth"
    cameras = information.get("Cameras")
    listed = cameras if isinstance(cameras, list) else []
    entry = next((c for c in listed if isinstance(c, Mapping) and c.get("Purpose") == wanted), {})
    lens = entry.get("Intrinsics")
    lens = lens if isinstance(lens, Mapping) else {}
    parameters = numbers_in(lens.get("ModelParameters", []), source, "'ModelParameters'")
    if len(parameters) < 14:
        raise CalibrationDataError(
            f"{source}: no camera of purpose '{wanted}' with 14 'ModelParameters'."
        )
    model = str(lens.get("ModelType", "")).rpartition("_")[2]
    if model not in ("LensDistortionModelBrownConrady", "LensDistortionModelRational6KT"):
        raise CalibrationDataError(f"{source}: lens model '{one_line(model)}' is not supported.")
    cx, cy, fx, fy, k1, k2, k3, k4, k5, k6, _, _, p2, p1 = parameters[:14]
    modes = {}
    for size, ((width, height), (left, top)) in _AZURE_MODES.items():
        middle = (cx * width - left - 0.5, cy * height - top - 0.5)
        modes[size] = ((fx * width, 0.0, middle[0]), (0.0, fy * height, middle[1]), (0.0, 0.0, 1.0))
    return {
        "K": modes[640, 576],
        "distortion": [k1, k2, p1, p2, k3, k4, k5, k6],
        "matrix_by_size": modes,
    }


def _bop(values: Mapping[str, Any], source: str, camera: str | None) -> dict[str, Any] | None:
    """Read the first image of BOP's scene_camera.json."""
    del source, camera
    first = next(iter(values.values()), None)
    if not isinstance(first, Mapping) or "cam_K" not in first:
        return None
    return {"K": first["cam_K"]}


def _chosen(cameras: Mapping[str, Any], source: str, camera: str | None) -> str:
    if camera is not None and camera in cameras:
        return camera
    if camera is None and len(cameras) == 1:
        return next(iter(cameras))
    listed = one_line(
        ", ".join(f"{name} ({entry.get('rostopic', '?')})" for name, entry in cameras.items())
    )
    first = one_line(str(next(iter(cameras))))
    raise CalibrationDataError(
        f"{source}: it holds the cameras {listed}. Name one: --intrinsics 'FILE#{first}'."
    )
