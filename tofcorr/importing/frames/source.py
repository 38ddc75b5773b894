"""Depth images of a folder, with amplitude and grey images of the same names."""

from pathlib import Path

import numpy as np

from tofcorr.errors import CalibrationDataError
from tofcorr.importing.checkerboard.importer import BoardImages, CheckerboardOptions
from tofcorr.importing.images import (
    DepthCoding,
    DepthImage,
    camera_of,
    coded_image,
    files_of_views,
    of_size,
    read_array,
    read_grey,
    times_in_names,
    turned,
)
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
    tool_from_camera: np.ndarray | None = None,
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
        tool_from_camera: The hand-eye transform, if it is known.

    Raises:
        CalibrationDataError: Nothing matches, the first image cannot be read, or the intrinsics
            hold for images of another size.
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
    files = [found[view] for view in names]

    def read(number: int) -> DepthImage:
        image = _coded(files[number], coding, "A preview serves to find a board's corners: name it "
                       "with --grey")  # fmt: skip
        return of_size(image, camera)

    def counts(number: int) -> np.ndarray:
        return turned(read_array(files[number]["depth"]), coding.rotate)

    camera = camera_of(intrinsics, counts, len(files), str(folder))
    return RobotImages(
        origin=str(folder),
        names=names,
        camera=camera,
        read=read,
        track=track,
        times=stamps,
        refused=refused,
        tool_from_camera=tool_from_camera,
    )


def _coded(files: dict[str, Path], coding: DepthCoding, advice: str) -> DepthImage:
    """Read the depth of a view, and its amplitude if it has one."""
    depth, *rest = (
        (read_array(files[what]), files[what].name)
        for what in ("depth", "amplitude")
        if what in files
    )
    return coded_image(coding, depth, next(iter(rest), None), advice)


def _times_of(path: Path) -> dict[str, float]:
    """Read `time name` lines: the time of each image by its file's name."""
    found: dict[str, float] = {}
    for number, fields in lines_of(read_text(path)):
        time = any_numbers(fields[0])
        if time.shape:
            raise CalibrationDataError(
                f"{path}, line {number}: expected a time and a file's name, got "
                f"'{' '.join(fields)[:60]}'."
            )
        found[Path(fields[-1]).name] = float(time)
    return found


def board_images(
    folder: Path,
    options: CheckerboardOptions,
    coding: DepthCoding,
    amplitude_pattern: str | None,
) -> BoardImages:
    """Find images of a board, without a robot.

    Args:
        folder: Where the images are.
        options: The board; `infrared_pattern` names the images in which its corners are found.
        coding: How depth is to be read.
        amplitude_pattern: Names of the amplitude images; None: there are none.

    Raises:
        CalibrationDataError: Nothing matches, or no images belong together.
    """
    patterns = {"depth": options.depth_pattern, "infrared": options.infrared_pattern}
    if amplitude_pattern is not None:
        patterns["amplitude"] = amplitude_pattern
    return BoardImages(
        *files_of_views(folder, patterns),
        lambda files: turned(read_grey(files["infrared"]), coding.rotate),
        lambda files: _coded(files, coding, "Name it with --grey alone: it serves to find corners"),
    )
