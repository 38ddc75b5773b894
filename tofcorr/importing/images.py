"""Depth, amplitude and grey images in files: found by name, decoded, and turned into metres."""

import os
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Literal, NamedTuple

import cv2
import numpy as np
from pydantic import PositiveFloat

from tofcorr.errors import CalibrationDataError
from tofcorr.files import open_regular
from tofcorr.geometry.camera import CameraIntrinsics
from tofcorr.importing.numbers import load_numbers
from tofcorr.importing.pose_track import LEAST_SECONDS, in_seconds
from tofcorr.importing.run import Refused, RefusedViewError
from tofcorr.options import Options, one_line


class DepthImage(NamedTuple):
    """One image.

    Attributes:
        depth: Metres, float32, shape (H, W); NaN where there is no return.
        amplitude: The camera's own linear units, shape (H, W); None without amplitudes.
    """

    depth: np.ndarray
    amplitude: np.ndarray | None = None


class DepthCoding(Options):
    """How the numbers of a depth image are to be read.

    Attributes:
        unit_mm: Millimetres per count; null: 1 for whole numbers, 1000 (metres) for floats.
        invalid: Numbers that mean "no return", besides NaN and everything up to zero.
        big_endian: Whether the two bytes of each number stand in the wrong order.
        rotate: Degrees clockwise by which images are turned before use.
    """

    unit_mm: PositiveFloat | None = None
    invalid: tuple[float, ...] = (0.0, 65535.0)
    big_endian: bool = False
    rotate: Literal[0, 90, 180, 270] = 0


def matching_files(folder: Path, pattern: str, what: str) -> dict[str, Path]:
    """Find the files that a pattern names, in natural order (2 before 10).

    Args:
        folder: Where the pattern starts.
        pattern: File name with `{view}`, or a glob with `*` and `?`; may name sub-folders.
        what: What the files are, for messages.

    Returns:
        The files by the text that the wildcards stand for; several texts are joined by "-".

    Raises:
        CalibrationDataError: There is no such folder, the pattern has no wildcard, or it matches
            nothing.
    """
    if not folder.is_dir():
        raise CalibrationDataError(f"{folder}: there is no such folder.")
    parts = re.split(r"(\{view\}|\*|\?)", pattern)
    if len(parts) == 1:
        raise CalibrationDataError(f"{what} pattern '{pattern}' names one file; put {{view}} or *.")
    wildcards = {"{view}": "([^/]+)", "*": "([^/]*)", "?": "([^/])"}
    regex = re.compile("".join(wildcards.get(part, re.escape(part)) for part in parts))
    found: dict[str, Path] = {}
    for path in folder.glob("/".join("*" * (pattern.count("/") + 1))):
        match = regex.fullmatch(path.relative_to(folder).as_posix())
        if match and path.is_file():
            found["-".join(match.groups())] = path
    if not found:
        names = sorted((path.name for path in folder.iterdir()), key=_natural_order)
        held = f"it holds '{names[0]}', ..., '{names[-1]}'" if names else "the folder is empty"
        raise CalibrationDataError(f"{folder}: no file matches {what} pattern '{pattern}'; {held}.")
    return {view: found[view] for view in sorted(found, key=_natural_order)}


def files_of_views(
    folder: Path, patterns: Mapping[str, str]
) -> tuple[dict[str, dict[str, Path]], Refused]:
    """Find the files that belong together: those whose wildcards match the same text.

    Images are never paired by their order: one missing file would shift all that follow.

    Args:
        folder: Where the patterns start.
        patterns: A pattern for each kind of image, as `matching_files` takes them.

    Returns:
        The files of each view by kind, in natural order (2 before 10), and why views lack some.

    Raises:
        CalibrationDataError: There is no such folder, a pattern has no wildcard or matches
            nothing, or no images belong together.
    """
    found = {what: matching_files(folder, pattern, what) for what, pattern in patterns.items()}
    every = sorted({view for files in found.values() for view in files}, key=_natural_order)
    views, refused = {}, Refused()
    for view in every:
        files = {what: found[what][view] for what in found if view in found[what]}
        if len(files) == len(found):
            views[view] = files
            continue
        lacking = next(what for what in found if what not in files)
        refused[view] = f"{next(iter(files.values())).name} has no {lacking} image beside it"
    if not views:
        first = next(iter(refused.values()))
        raise CalibrationDataError(f"{folder}: no view has images of each kind: {first}.")
    return views, refused


def _natural_order(text: str) -> list[tuple[int, str]]:
    """Return a key that sorts numbers in names by their value."""
    return [(int(p), "") if p.isdecimal() else (-1, p) for p in re.split(r"(\d+)", text)]


def times_in_names(views: list[str]) -> np.ndarray | None:
    """Return the times that all names are, seconds, shape (N,); None if they are none.

    A time is a number with a decimal point, or a whole number of seconds, milliseconds,
    microseconds or nanoseconds since 1970; smaller ones are numbers of images.
    """
    if not all(re.fullmatch(r"\d+(\.\d+)?", view) for view in views):
        return None
    values = np.array([float(view) for view in views])
    if all("." in view for view in views):
        return values
    return None if values.min() < LEAST_SECONDS else in_seconds(values)


def read_array(path: Path) -> np.ndarray:
    """Read a grey image (PNG, TIFF, PGM), an NPY array, or an EXR image, shape (H, W).

    Raises:
        RefusedViewError: The file cannot be read, is no image, or has several channels.
    """
    reader = {".npy": _npy, ".exr": _exr}.get(path.suffix.lower(), read_image)
    return _one_channel(reader(path), path)


def read_grey(path: Path) -> np.ndarray:
    """Read an image in which corners are to be found: grey or colour, of any depth, shape (H, W).

    Raises:
        RefusedViewError: The file cannot be read, or is no image.
    """
    if path.suffix.lower() in (".npy", ".exr"):
        return read_array(path)
    grey = cv2.IMREAD_ANYDEPTH | cv2.IMREAD_IGNORE_ORIENTATION
    return _one_channel(read_image(path, grey), path)


def _one_channel(array: np.ndarray, path: Path) -> np.ndarray:
    if array.ndim == 3 and 1 in (array.shape[0], array.shape[2]):
        array = array.squeeze()
    if array.ndim != 2 or not array.size:
        raise RefusedViewError(f"{path.name} has shape {array.shape}; one channel is needed")
    return array


def read_image(path: Path, how: int = cv2.IMREAD_UNCHANGED) -> np.ndarray:
    """Decode an image file, as it is unless said otherwise, shape (H, W) or (H, W, channels).

    Raises:
        RefusedViewError: The file cannot be read, or is no image.
    """
    try:
        with open_regular(path) as file:
            image = decoded(file.read(), how)
    except OSError as error:
        reason = error.strerror or error
        raise RefusedViewError(f"{path.name} cannot be read ({reason})") from None
    if image is None:
        raise RefusedViewError(f"{path.name} is not a readable image; is it truncated?")
    return image


def decoded(content: bytes, how: int = cv2.IMREAD_UNCHANGED) -> np.ndarray | None:
    """Decode the bytes of an image file by OpenCV's flags; None if they are none."""
    try:
        return cv2.imdecode(np.frombuffer(content, np.uint8), how)
    except cv2.error:  # Of no bytes too.
        return None


def _npy(path: Path) -> np.ndarray:
    return load_numbers(path, lambda why: RefusedViewError(f"{path.name}: {why}"))


def _exr(path: Path) -> np.ndarray:
    """Read the depth channel of an EXR file.

    That is Z, alone or of a layer that is called depth, as Blender's `ViewLayer.Depth.Z`; else the
    only channel, or the red one of a file that holds one picture.
    """
    try:
        import OpenEXR
    except ImportError:
        raise RefusedViewError(f"{path} needs OpenEXR: pip install 'tofcorr[exr]'") from None
    try:
        with open_regular(path), OpenEXR.File(os.fspath(path), separate_channels=True) as file:
            channels = file.channels()
            names = list(channels)
            of_depth = [n for n in names if re.search(r"depth\.[zv]$", n, re.IGNORECASE)]
            single = names if len(names) == 1 else []
            for name in ("Z", *of_depth, *single, "V", "Y", "R"):
                if name in names:
                    return np.array(channels[name].pixels)
    except (OSError, RuntimeError, ValueError, IndexError) as error:
        raise RefusedViewError(f"{path.name} is not a readable EXR file ({error})") from None
    listed = one_line(", ".join(names))
    raise RefusedViewError(f"{path.name} holds channels {listed}; expected Z, depth.Z or depth.V")


Counts = tuple[np.ndarray, str]
"""An image as a file or a message holds it, and what it is called there."""


def read_depth(files: Mapping[str, Path], coding: DepthCoding) -> DepthImage:
    """Read the `depth` of a view, and its `amplitude` if there is one.

    Raises:
        RefusedViewError: A file cannot be read, or as in `coded_image`.
    """
    given = (files[what] for what in ("depth", "amplitude") if what in files)
    return coded_image(coding, *((read_array(path), path.name) for path in given))


def coded_image(coding: DepthCoding, depth: Counts, amplitude: Counts | None = None) -> DepthImage:
    """Return an image in metres, turned as the coding says.

    Args:
        coding: How the numbers are to be read.
        depth: The depth.
        amplitude: The amplitude; None: there is none.

    Raises:
        RefusedViewError: An image has 8 bits a pixel, or the depth's bytes stand in the wrong
            order.
    """
    counts, name = depth
    _refuse_preview(depth, "depth (an 8-bit image is a preview)")
    if counts.dtype.kind in "iu" and counts.dtype.itemsize == 2:
        if coding.big_endian:
            counts = counts.byteswap()
        else:
            _refuse_swapped(counts, name)
    values = counts.astype(np.float64)
    metres = values * (coding.unit_mm or (1000.0 if counts.dtype.kind == "f" else 1.0)) / 1000
    # Renderers write 1e10 m where nothing was hit.
    usable = (metres > 0) & (metres < 10**5) & ~np.isin(values, coding.invalid)
    metres = np.where(usable, metres, np.nan).astype(np.float32)
    image = DepthImage(turned(metres, coding.rotate))
    if amplitude is None:
        return image
    _refuse_preview(amplitude, "amplitude (a preview serves to find a board alone: --grey)")
    return image._replace(amplitude=turned(amplitude[0].astype(np.float32), coding.rotate))


def _refuse_preview(image: Counts, kind: str) -> None:
    if image[0].dtype.itemsize == 1:
        raise RefusedViewError(f"{image[1]} has 8 bits a pixel; expected 16 or floats as {kind}")


def of_size(image: DepthImage, camera: CameraIntrinsics) -> DepthImage:
    """Return the image, unless a camera of other intrinsics took it.

    Raises:
        RefusedViewError: Depth or amplitude is of another size.
    """
    for name, part in image._asdict().items():
        if part is not None and part.shape != (camera.height, camera.width):
            size = f"{part.shape[1]}x{part.shape[0]}"
            expected = f"the intrinsics hold for {camera.width}x{camera.height}"
            raise RefusedViewError(f"its {name} has {size} pixels, {expected}")
    return image


def turned(image: np.ndarray, degrees: int) -> np.ndarray:
    """Return an image turned clockwise by 0, 90, 180 or 270 degrees."""
    return np.ascontiguousarray(np.rot90(image, -(degrees // 90)))


def _refuse_swapped(counts: np.ndarray, name: str, smoother: int = 4) -> None:
    """Refuse an image that is `smoother` times as smooth with the bytes of each number swapped.

    Depth read with the bytes swapped jumps by thousands between neighbours: on views of a Kinect v2
    the ratio is 100 to 270 in the wrong order, and its inverse in the right one.
    """
    few = counts[::4]  # Thousands of pixels, quickly.
    here, swapped = _roughness(few), _roughness(few.byteswap())
    if here > smoother * swapped > 0:
        said = f"neighbours differ by {here:.0f} counts, with bytes swapped by {swapped:.0f}"
        raise RefusedViewError(f"{name}: {said}. Add --big-endian")


def _roughness(counts: np.ndarray) -> float:
    """Return the mean difference of horizontal neighbours that both have a return."""
    left, right = counts[:, :-1].astype(np.int64), counts[:, 1:].astype(np.int64)
    both = (left != 0) & (right != 0)
    return float(np.abs(left - right)[both].mean()) if both.any() else 0.0
