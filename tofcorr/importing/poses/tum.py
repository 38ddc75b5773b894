"""TUM trajectories: `timestamp tx ty tz qx qy qz qw` a line, metres and seconds."""

from pathlib import Path

import numpy as np

from tofcorr.errors import CalibrationDataError
from tofcorr.importing.poses.rotations import matrix_from_quaternion
from tofcorr.importing.poses.text import lines_of, numbers_of, read_text
from tofcorr.importing.poses.track import PoseTrack


def read_tum(path: Path) -> PoseTrack:
    """Read a trajectory in TUM's format.

    Raises:
        CalibrationDataError: The file cannot be read or a line is not a pose.
    """
    times, poses = [], []
    for line in lines_of(read_text(path)):
        values = numbers_of(line, path, (8,))
        try:
            poses.append(matrix_from_quaternion(values[1:4], values[4:]))
        except ValueError as error:
            raise CalibrationDataError(f"{path}, line {line.number}: {error}.") from None
        times.append(values[0])
    return PoseTrack.checked(np.array(poses), str(path), np.array(times))
