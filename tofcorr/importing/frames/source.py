"""Depth images of a folder, with amplitude and grey images of the same names."""

from pathlib import Path

import numpy as np

from tofcorr.errors import CalibrationDataError
from tofcorr.importing.images import DepthCoding, files_of_views, read_depth, times_in_names
from tofcorr.importing.intrinsics import GivenIntrinsics
from tofcorr.importing.numbers import any_numbers, lines_of, read_text
from tofcorr.importing.pose_track import PoseTrack
from tofcorr.importing.robot_images import RobotImages


def open_folder(
    folder: Path,
    depth_pattern: str,
    intrinsics: GivenIntrinsics,
    coding: DepthCoding,
    track: PoseTrack,
    *,
    amplitude_pattern: str | None = None,
    times: Path | None = None,
) -> RobotImages:
    """Find the images of a folder.

    Args:
        folder: Where the patterns start.
        depth_pattern: Names of the depth images, with `{view}` or wildcards.
        intrinsics: The camera's intrinsics, of images as they are after `coding.rotate`.
        coding: How depth is to be read.
        track: The robot's poses.
        amplitude_pattern: Names of the amplitude images; what the wildcard stands for is the same.
        times: A list of `time name` lines (as TUM's depth.txt); None: the names themselves, if
            they are times.

    Raises:
        CalibrationDataError: Nothing matches.
    """
    given = {"depth": depth_pattern, "amplitude": amplitude_pattern}
    found, refused = files_of_views(folder, {kind: one for kind, one in given.items() if one})
    names, stamps = list(found), times_in_names(list(found))
    if times is not None:
        listed = _times_of(times)
        stamps = np.array([listed.get(found[view]["depth"].name, np.nan) for view in names])
        unlisted = [names[k] for k in np.flatnonzero(np.isnan(stamps))]
        refused |= dict.fromkeys(unlisted, f"{times} does not list it")
        if len(unlisted) == len(names):
            first = found[names[0]]["depth"].name
            raise CalibrationDataError(f"{times}: lists none of the images, such as '{first}'.")
    if stamps is not None:
        order = np.argsort(stamps, kind="stable")[: np.isfinite(stamps).sum()]
        names, stamps = [names[k] for k in order], stamps[order]
    return RobotImages(
        origin=str(folder),
        names=names,
        intrinsics=intrinsics,
        read=lambda number: read_depth(found[names[number]], coding),
        track=track,
        times=stamps,
        refused=refused,
    )


def _times_of(path: Path) -> dict[str, float]:
    """Read `time name` lines: the time of each image by its file's name."""
    found: dict[str, float] = {}
    for number, fields in lines_of(read_text(path)):
        time = any_numbers(fields[0])
        if time.shape:
            raise CalibrationDataError(f"{path}, line {number}: '{fields[0][:60]}' is not a time.")
        found[Path(fields[-1]).name] = float(time)
    return found
