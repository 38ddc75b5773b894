"""Depth images of a folder, with amplitude and grey images of the same names."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from tofcorr.errors import CalibrationDataError
from tofcorr.geometry.camera import CameraIntrinsics
from tofcorr.importing.given_intrinsics import GivenIntrinsics
from tofcorr.importing.images.coding import DepthCoding, amplitude_counts, depth_metres, turned
from tofcorr.importing.images.decode import read_array
from tofcorr.importing.images.series import find_series
from tofcorr.importing.poses.text import lines_of, read_text
from tofcorr.importing.report import Refusal, RefusedViewError
from tofcorr.importing.source import DepthImage

_PREVIEW = "A preview serves to find a board's corners: name it with --grey"


@dataclass(frozen=True, kw_only=True, eq=False)
class FolderSource:
    """Depth images of a folder; a `tofcorr.importing.source.DepthSource`.

    Attributes:
        origin: The folder.
        names: What the wildcard of the pattern stands for in each image's name.
        times: Seconds, shape (N,); None where names are no times and none were given.
        camera: The camera's intrinsics.
        refused: Depth images without the amplitude image that belongs to them.
    """

    origin: str
    names: Sequence[str]
    times: np.ndarray | None
    camera: CameraIntrinsics
    refused: list[Refusal]
    _depth: Sequence[Path]
    _amplitude: Sequence[Path] | None
    _coding: DepthCoding

    def read(self, number: int) -> DepthImage:
        """Read one image.

        Raises:
            RefusedViewError: It cannot be read, has 8 bits a pixel, or is of another size.
        """
        path, coding = self._depth[number], self._coding
        depth = depth_metres(read_array(path), coding, path.name)
        amplitude = None
        if self._amplitude is not None:
            beside = self._amplitude[number]
            amplitude = amplitude_counts(read_array(beside), coding, beside.name, _PREVIEW)
        return DepthImage(depth, amplitude).of(self.camera)


def open_folder(
    folder: Path,
    depth_pattern: str,
    intrinsics: GivenIntrinsics,
    coding: DepthCoding,
    *,
    amplitude_pattern: str | None = None,
    times: Path | None = None,
) -> FolderSource:
    """Find the images of a folder.

    Args:
        folder: Where the patterns start.
        depth_pattern: Names of the depth images, with `{view}` or wildcards.
        intrinsics: The camera's intrinsics, of images as they are after `coding.rotate`.
        coding: How depth is to be read.
        amplitude_pattern: Names of the amplitude images; what the wildcard stands for is the same.
        times: A list of `time name` lines (as TUM's depth.txt); None: the names themselves, if
            they are times.

    Raises:
        CalibrationDataError: Nothing matches, the first image cannot be read, or the intrinsics
            hold for images of another size.
    """
    series = find_series(folder, depth_pattern, "depth")
    views, paths, stamps = list(series.views), list(series.paths), series.times
    beside: dict[str, Path] | None = None
    refused: list[Refusal] = []
    if amplitude_pattern is not None:
        found = find_series(folder, amplitude_pattern, "amplitude")
        beside = dict(zip(found.views, found.paths, strict=True))
        lacking = [view for view in views if view not in beside]
        if len(lacking) == len(views):
            raise CalibrationDataError(
                f"{folder}: no depth image has an amplitude image of the same name: "
                f"'{depth_pattern}' matches '{paths[0].name}', '{amplitude_pattern}' matches "
                f"'{found.paths[0].name}'. What the wildcard stands for must be the same in both."
            )
        refused += [
            Refusal(view=view, reason="there is no amplitude image beside it") for view in lacking
        ]
    listed = None if times is None else _times_of(times)
    if listed is not None:
        refused += [
            Refusal(view=view, reason=f"{times} does not list it")
            for view, path in zip(views, paths, strict=True)
            if path.name not in listed
        ]
    left_out = {refusal.view for refusal in refused}
    kept = [k for k, view in enumerate(views) if view not in left_out]
    if not kept:
        raise CalibrationDataError(f"{times}: lists none of the images, such as '{paths[0].name}'.")
    if listed is not None:
        kept.sort(key=lambda k: listed[paths[k].name])
        stamps = np.array([listed[path.name] for path in paths])
    names = [views[k] for k in kept]
    return FolderSource(
        origin=str(folder),
        names=names,
        times=None if stamps is None else stamps[kept],
        camera=_camera(intrinsics, [paths[k] for k in kept], coding),
        refused=refused,
        _depth=[paths[k] for k in kept],
        _amplitude=None if beside is None else [beside[name] for name in names],
        _coding=coding,
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
    for line in lines_of(read_text(path)):
        try:
            found[Path(line.fields[-1]).name] = float(line.fields[0])
        except ValueError:
            raise CalibrationDataError(
                f"{path}, line {line.number}: expected a time and a file's name, got "
                f"'{' '.join(line.fields)[:60]}'."
            ) from None
    return found
