"""Depth, amplitude and grey images in files: found by name, decoded, and turned into metres."""

import os
import re
from pathlib import Path
from typing import Literal, NamedTuple, Self

import cv2
import numpy as np
from pydantic import PositiveFloat

from tofcorr.errors import CalibrationDataError
from tofcorr.geometry.camera import CameraIntrinsics
from tofcorr.importing.npy import load_numbers
from tofcorr.importing.pose_track import in_seconds
from tofcorr.importing.run import RefusedViewError
from tofcorr.options import Options, one_line

_GROUPS = {"{view}": "([^/]+)", "*": "([^/]*)", "?": "([^/])"}
"""What the wildcards of a pattern stand for."""

_LARGEST_GB = 1
"""Largest image file read, GB: a hundred times a 4-megapixel depth image in float64."""

_LEAST_SECONDS = 1e8
"""Numbers in names count as times from here on, or with a decimal point: in Unix seconds it
is 1973, and no folder has as many images."""

_SWAPPED_SMOOTHER = 4.0
"""How many times smoother an image is with its bytes swapped if they are in the wrong order. Depth
read with the bytes swapped jumps by thousands between neighbours: on views of a Kinect v2 the
ratio is 100 to 270 in the wrong order, and its inverse in the right one."""


class DepthImage(NamedTuple):
    """One image.

    Attributes:
        depth: Metres, float32, shape (H, W); NaN where there is no return.
        amplitude: The camera's own linear units, shape (H, W); None without amplitudes.
    """

    depth: np.ndarray
    amplitude: np.ndarray | None = None

    def of(self, camera: CameraIntrinsics) -> Self:
        """Return the image, unless a camera of other intrinsics took it.

        Raises:
            RefusedViewError: Depth or amplitude is of another size.
        """
        size = (camera.height, camera.width)
        for what, image in self._asdict().items():
            if image is not None and image.shape != size:
                raise RefusedViewError(
                    f"its {what} has {image.shape[1]}x{image.shape[0]} pixels, the intrinsics hold "
                    f"for {size[1]}x{size[0]}"
                )
        return self


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
        raise CalibrationDataError(
            f"the {what} pattern '{pattern}' names one file; put {{view}} or * where the images "
            "differ."
        )
    regex = re.compile("".join(_GROUPS.get(part, re.escape(part)) for part in parts))
    found: dict[str, Path] = {}
    for path in folder.glob("/".join("*" * (pattern.count("/") + 1))):
        match = regex.fullmatch(path.relative_to(folder).as_posix())
        if match and path.is_file():
            found["-".join(match.groups())] = path
    if not found:
        names = sorted((path.name for path in folder.iterdir()), key=natural_order) or [""]
        held = f"it holds {len(names)} entries such as '{names[0]}' and '{names[-1]}'"
        held = held if names[0] else "the folder is empty"
        raise CalibrationDataError(
            f"{folder}: no file matches the {what} pattern '{pattern}'; {held}."
        )
    return {view: found[view] for view in sorted(found, key=natural_order)}


def natural_order(text: str) -> list[tuple[int, str]]:
    """Return a key that sorts numbers in names by their value."""
    return [(int(p), "") if p.isdecimal() else (-1, p) for p in re.split(r"(\d+)", text)]


def times_in_names(views: list[str]) -> np.ndarray | None:
    """Return the times that all names are, seconds, shape (N,); None if they are none.

    A time is a number with a decimal point, or a whole number of seconds, milliseconds,
    microseconds or nanoseconds since 1970.
    """
    if not all(re.fullmatch(r"\d+(\.\d+)?", view) for view in views):
        return None
    values = np.array([float(view) for view in views])
    if all("." in view for view in views):
        return values
    return None if values.min() < _LEAST_SECONDS else in_seconds(values)


def read_array(path: Path) -> np.ndarray:
    """Read a grey image (PNG, TIFF, PGM), an NPY array or an EXR channel, shape (H, W).

    Raises:
        RefusedViewError: The file cannot be read, is no image, or has several channels.
    """
    try:
        size = path.stat().st_size
    except OSError as error:
        raise RefusedViewError(f"{path.name} cannot be read ({error.strerror})") from None
    if size > _LARGEST_GB * 1e9:
        raise RefusedViewError(f"{path.name} is larger than {_LARGEST_GB} GB")
    array = {".npy": _npy, ".exr": _exr}.get(path.suffix.lower(), read_image)(path)
    if array.ndim == 3 and 1 in (array.shape[0], array.shape[2]):
        array = array.squeeze()
    if array.ndim != 2 or not array.size:
        raise RefusedViewError(
            f"{path.name} has shape {array.shape}; one channel of shape (rows, columns) is needed"
        )
    return array


def read_grey(path: Path) -> np.ndarray:
    """Read an image in which corners are to be found: grey or colour, of any depth, shape (H, W).

    Raises:
        RefusedViewError: The file cannot be read, or is no image.
    """
    if path.suffix.lower() in (".npy", ".exr"):
        return read_array(path)
    image = read_image(path)
    if image.ndim == 2:
        return image
    if image.ndim != 3 or image.shape[2] not in (3, 4):
        raise RefusedViewError(f"{path.name} has shape {image.shape}; grey or colour is needed")
    code = cv2.COLOR_BGR2GRAY if image.shape[2] == 3 else cv2.COLOR_BGRA2GRAY
    return np.asarray(cv2.cvtColor(image, code))


def read_image(path: Path) -> np.ndarray:
    """Decode an image file without conversion, shape (H, W) or (H, W, channels).

    Raises:
        RefusedViewError: The file cannot be read, or is no image.
    """
    try:
        image = decoded(path.read_bytes())
    except OSError as error:
        raise RefusedViewError(f"{path.name} cannot be read ({error.strerror})") from None
    if image is None:
        raise RefusedViewError(f"{path.name} is not a readable image; is it truncated?")
    return image


def decoded(content: bytes) -> np.ndarray | None:
    """Decode the bytes of an image file; None if they are none."""
    try:
        return cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_UNCHANGED)
    except cv2.error:  # Of no bytes too.
        return None


def _npy(path: Path) -> np.ndarray:
    try:
        return load_numbers(path)
    except ValueError as error:
        raise RefusedViewError(f"{path.name}: {error}") from None


def _exr(path: Path) -> np.ndarray:
    """Read the depth channel of an EXR file.

    That is Z, alone or of a layer that is called depth, as Blender's `ViewLayer.Depth.Z`; else the
    only channel, or the red one of a file that holds one picture.
    """
    try:
        import OpenEXR
    except ImportError:
        raise RefusedViewError(
            f"{path.name} needs the package OpenEXR: pip install 'tofcorr[exr]'"
        ) from None
    try:
        with OpenEXR.File(os.fspath(path), separate_channels=True) as file:
            channels = file.channels()
            names = list(channels)
            of_depth = [n for n in names if re.search(r"depth\.[zv]$", n, re.IGNORECASE)]
            single = names if len(names) == 1 else []
            wanted = ("Z", *of_depth, *single, "V", "Y", "R")
            chosen = next((name for name in wanted if name in names), None)
            if chosen is not None:
                return np.array(channels[chosen].pixels)
    except (OSError, RuntimeError, ValueError, IndexError) as error:
        raise RefusedViewError(f"{path.name} is not a readable EXR file ({error})") from None
    raise RefusedViewError(
        f"{path.name} holds the channels {one_line(', '.join(names))}; expected one that is called "
        "Z, depth.Z or depth.V"
    )


def depth_metres(counts: np.ndarray, coding: DepthCoding, name: str) -> np.ndarray:
    """Return depth in metres, float32, shape (H, W); NaN where there is no return.

    Raises:
        RefusedViewError: The image has 8 bits a pixel, or its bytes stand in the wrong order.
    """
    if counts.dtype.itemsize == 1:
        raise RefusedViewError(
            f"{name} has 8 bits a pixel; expected 16 bits or floats (an 8-bit image is a preview, "
            "its depth is lost)"
        )
    if counts.dtype.kind in "iu" and counts.dtype.itemsize == 2:
        if coding.big_endian:
            counts = counts.byteswap()
        else:
            _refuse_swapped(counts, name)
    values = counts.astype(np.float64)
    usable = np.isfinite(values) & (values > 0) & ~np.isin(values, coding.invalid)
    unit_mm = coding.unit_mm or (1000.0 if counts.dtype.kind == "f" else 1.0)
    metres = np.where(usable, values * (1e-3 * unit_mm), np.nan)
    return turned(metres.astype(np.float32), coding.rotate)


def amplitude_counts(
    counts: np.ndarray, coding: DepthCoding, name: str, advice: str = ""
) -> np.ndarray:
    """Return amplitudes in the camera's units, float32, shape (H, W), turned as depth is.

    Args:
        counts: As read.
        coding: How far images are to be turned.
        name: Of the image, for the message.
        advice: What else to do with an image of 8 bits, a sentence without a full stop.

    Raises:
        RefusedViewError: The image has 8 bits a pixel.
    """
    if counts.dtype.itemsize == 1:
        raise RefusedViewError(
            f"{name} has 8 bits a pixel; expected 16 bits or floats as amplitude"
            + (advice and f". {advice}")
        )
    return turned(counts.astype(np.float32), coding.rotate)


def turned(image: np.ndarray, degrees: int) -> np.ndarray:
    """Return an image turned clockwise by 0, 90, 180 or 270 degrees."""
    return np.ascontiguousarray(np.rot90(image, -(degrees // 90)))


def _refuse_swapped(counts: np.ndarray, name: str) -> None:
    """Refuse an image that is much smoother with the bytes of each number swapped."""
    few = counts[::4]  # Thousands of pixels, quickly.
    here, swapped = _roughness(few), _roughness(few.byteswap())
    if here > _SWAPPED_SMOOTHER * swapped and swapped > 0:
        raise RefusedViewError(
            f"{name}: neighbours differ by {here:.0f} counts as read and by {swapped:.0f} with the "
            "bytes swapped; the image seems to be big-endian. Add --big-endian"
        )


def _roughness(counts: np.ndarray) -> float:
    """Return the mean difference of horizontal neighbours that both have a return."""
    left, right = counts[:, :-1].astype(np.int64), counts[:, 1:].astype(np.int64)
    both = (left != 0) & (right != 0)
    return float(np.abs(left - right)[both].mean()) if both.any() else 0.0
