"""Depth images of a folder, with amplitude and grey images of the same names."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from tofcorr.errors import CalibrationDataError
from tofcorr.geometry.camera import CameraIntrinsics
from tofcorr.importing.checkerboard.importer import (
    BoardImages,
    CheckerboardOptions,
    ImagePair,
    find_pairs,
    import_checkerboard,
    refuse_other_size,
)
from tofcorr.importing.images import (
    DepthCoding,
    DepthImage,
    amplitude_counts,
    depth_metres,
    matching_files,
    read_array,
    read_grey,
    times_in_names,
    turned,
)
from tofcorr.importing.intrinsics import GivenIntrinsics
from tofcorr.importing.pose_files import lines_of, read_text
from tofcorr.importing.pose_track import PoseTrack
from tofcorr.importing.robot_images import RobotImages
from tofcorr.importing.run import Progress, Refusal, RefusedViewError, no_progress

_PREVIEW = "A preview serves to find a board's corners: name it with --grey"
_CORNERS_ONLY = "Name it with --grey alone: it serves to find corners"
_ALONE = "there is no amplitude image beside it"


def found_images(
    folder: Path, pattern: str, what: str
) -> tuple[dict[str, Path], np.ndarray | None]:
    """Find the images of a folder that a pattern names.

    Args:
        folder: Where the pattern starts.
        pattern: File name with `{view}`, or a glob with `*` and `?`; may name sub-folders.
        what: What the files are, for messages.

    Returns:
        The files by what the wildcard stands for, in natural order, or in that of the times that
        the names are; and those times, seconds, shape (N,), or None.

    Raises:
        CalibrationDataError: There is no such folder, the pattern has no wildcard, or it matches
            nothing.
    """
    found = matching_files(folder, pattern, what)
    views, times = list(found), times_in_names(list(found))
    if times is None:
        return found, None
    order = np.argsort(times, kind="stable")
    return {views[k]: found[views[k]] for k in order}, times[order]


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
    found, stamps = found_images(folder, depth_pattern, "depth")
    beside: dict[str, Path] = {}
    refused: list[Refusal] = []
    if amplitude_pattern is not None:
        beside = matching_files(folder, amplitude_pattern, "amplitude")
        refused = [Refusal(view, _ALONE) for view in found if view not in beside]
        if len(refused) == len(found):
            first, other = (next(iter(paths.values())).name for paths in (found, beside))
            raise CalibrationDataError(
                f"{folder}: no depth image has an amplitude image of the same name: "
                f"'{depth_pattern}' matches '{first}', '{amplitude_pattern}' matches "
                f"'{other}'. What the wildcard stands for must be the same in both."
            )
    listed = None if times is None else _times_of(times)
    if listed is not None:
        stamps = np.array([listed.get(path.name, np.nan) for path in found.values()])
        refused += [
            Refusal(view, f"{times} does not list it")
            for view, stamp in zip(found, stamps, strict=True)
            if np.isnan(stamp)
        ]
    left_out = {refusal.view for refusal in refused}
    kept = np.array([k for k, view in enumerate(found) if view not in left_out], dtype=int)
    if not len(kept):
        first = next(iter(found.values())).name
        raise CalibrationDataError(f"{times}: lists none of the images, such as '{first}'.")
    if listed is not None and stamps is not None:
        kept = kept[np.argsort(stamps[kept], kind="stable")]
    names = [list(found)[k] for k in kept]

    def read(number: int) -> DepthImage:
        path, amplitude = found[names[number]], beside.get(names[number])
        depth = depth_metres(read_array(path), coding, path.name)
        counts = None
        if amplitude is not None:
            counts = amplitude_counts(read_array(amplitude), coding, amplitude.name, _PREVIEW)
        return DepthImage(depth, counts).of(camera)

    camera = _camera(intrinsics, [found[name] for name in names], coding)
    return RobotImages(
        origin=str(folder),
        names=names,
        camera=camera,
        read=read,
        track=track,
        times=None if stamps is None else stamps[kept],
        refused=refused,
        tool_from_camera=tool_from_camera,
    )


def _camera(
    intrinsics: GivenIntrinsics, paths: Sequence[Path], coding: DepthCoding
) -> CameraIntrinsics:
    """Return the intrinsics for images of the first readable size."""
    reason = ""
    for path in paths:
        try:
            height, width = turned(read_array(path), coding.rotate).shape
        except RefusedViewError as refusal:
            reason = reason or str(refusal)
            continue
        if intrinsics.size == (height, width) and height != width:
            raise CalibrationDataError(
                f"{intrinsics.source}: the intrinsics hold for {height}x{width} pixels, the images "
                f"have {width}x{height}: they seem to be turned. Add --rotate 90 or --rotate 270."
            )
        return intrinsics.camera((width, height))
    raise CalibrationDataError(
        f"none of {len(paths)} depth images can be read; the first: {reason}."
    )


def _times_of(path: Path) -> dict[str, float]:
    """Read `time name` lines: the time of each image by its file's name."""
    found: dict[str, float] = {}
    for number, fields in lines_of(read_text(path)):
        try:
            found[Path(fields[-1]).name] = float(fields[0])
        except ValueError:
            raise CalibrationDataError(
                f"{path}, line {number}: expected a time and a file's name, got "
                f"'{' '.join(fields)[:60]}'."
            ) from None
    return found


def import_boards(
    folder: Path,
    out: Path,
    options: CheckerboardOptions,
    coding: DepthCoding,
    intrinsics: GivenIntrinsics | None,
    *,
    amplitude_pattern: str | None,
    progress: Progress = no_progress,
) -> dict[str, Any]:
    """Turn images of a board into a recording, without a robot.

    Args:
        folder: Where the images are.
        out: The recording to write; it must not exist yet.
        options: The board; `infrared_pattern` names the images in which its corners are found.
        coding: How depth is to be read.
        intrinsics: The camera intrinsics; None: calibrate them from the board.
        amplitude_pattern: Names of the amplitude images; None: there are none.
        progress: Shows how far a step has come.

    Raises:
        CalibrationDataError: As `tofcorr.importing.checkerboard.importer.import_checkerboard`.
    """

    def images(folder: Path, options: CheckerboardOptions) -> BoardImages:
        beside: dict[str, Path] = {}
        if amplitude_pattern is not None:
            beside = matching_files(folder, amplitude_pattern, "amplitude")
        pairs, alone = find_pairs(folder, options.depth_pattern, options.infrared_pattern)
        if amplitude_pattern is not None:
            alone += [Refusal(pair.view, _ALONE) for pair in pairs if pair.view not in beside]
            pairs = [pair for pair in pairs if pair.view in beside]

        def measured(
            pair: ImagePair, camera: CameraIntrinsics
        ) -> tuple[np.ndarray, np.ndarray | None]:
            depth = depth_metres(read_array(pair.depth), coding, pair.depth.name)
            refuse_other_size(pair.depth, depth, camera)
            if amplitude_pattern is None:
                return depth, None
            path = beside[pair.view]
            counts = amplitude_counts(read_array(path), coding, path.name, _CORNERS_ONLY)
            refuse_other_size(path, counts, camera)
            return depth, counts

        def with_corners(pair: ImagePair) -> np.ndarray:
            return turned(read_grey(pair.infrared), coding.rotate)

        return BoardImages(pairs, alone, with_corners, measured)

    return import_checkerboard(folder, out, options, intrinsics, progress, images)
