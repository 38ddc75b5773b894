"""Samples of MoveIt's hand-eye calibration: a YAML list of pairs of poses."""

from pathlib import Path
from typing import Any

import numpy as np

from tofcorr.errors import CalibrationDataError, ConfigError
from tofcorr.importing.poses.track import PoseTrack
from tofcorr.options import read_yaml


def read_moveit(path: Path) -> PoseTrack:
    """Read `effector_wrt_world` of every sample (moveit/moveit_calibration#34).

    A sample is written when it is taken: samples and images belong together in their order.
    `object_wrt_sensor` is not used: depth is what tofcorr measures.

    Raises:
        CalibrationDataError: The file is not such a list.
    """
    try:
        values = read_yaml(path)
    except ConfigError as error:
        raise CalibrationDataError(str(error)) from None
    if not isinstance(values, list):
        raise CalibrationDataError(
            f"{path}: expected a list of samples, got {type(values).__name__}."
        )
    poses = [_pose(sample, f"{path}: sample {place}") for place, sample in enumerate(values)]
    return PoseTrack.checked(np.array(poses), str(path))


def _pose(sample: Any, where: str) -> np.ndarray:  # noqa: ANN401 - from a file
    given = sample.get("effector_wrt_world") if isinstance(sample, dict) else None
    try:
        numbers = np.asarray(given, dtype=np.float64).ravel()
    except (TypeError, ValueError, OverflowError):
        numbers = np.zeros(0)
    if numbers.size != 16:
        raise CalibrationDataError(
            f"{where}: expected 'effector_wrt_world' with the 16 numbers of a 4x4 matrix, "
            f"got {numbers.size}."
        )
    return numbers.reshape(4, 4)
