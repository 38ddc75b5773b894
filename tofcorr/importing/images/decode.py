"""Image files as arrays, in the numbers that they hold."""

import os
import re
from pathlib import Path

import cv2
import numpy as np

from tofcorr.importing.npy import load_numbers
from tofcorr.importing.report import RefusedViewError
from tofcorr.options.messages import one_line

_MOST_BYTES = 1_000_000_000
"""Largest image file read, bytes: a hundred times a 4-megapixel depth image in float64."""


def read_array(path: Path) -> np.ndarray:
    """Read a grey image (PNG, TIFF, PGM), an NPY array or an EXR channel, shape (H, W).

    Raises:
        RefusedViewError: The file cannot be read, is no image, or has several channels.
    """
    suffix = path.suffix.lower()
    try:
        size = path.stat().st_size
    except OSError as error:
        raise RefusedViewError(f"{path.name} cannot be read ({error.strerror})") from None
    if size > _MOST_BYTES:
        raise RefusedViewError(f"{path.name} is larger than {_MOST_BYTES / 1e9:g} GB")
    if suffix == ".npy":
        array = _npy(path)
    elif suffix == ".exr":
        array = _exr(path)
    else:
        array = read_image(path)
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
        content = np.frombuffer(path.read_bytes(), np.uint8)
        image = cv2.imdecode(content, cv2.IMREAD_UNCHANGED) if content.size else None
    except OSError as error:
        raise RefusedViewError(f"{path.name} cannot be read ({error.strerror})") from None
    except cv2.error:
        image = None
    if image is None:
        raise RefusedViewError(f"{path.name} is not a readable image; is it truncated?")
    return np.asarray(image)


def _npy(path: Path) -> np.ndarray:
    try:
        return load_numbers(path)
    except ValueError as error:
        raise RefusedViewError(f"{path.name}: {error}") from None


def _exr(path: Path) -> np.ndarray:
    """Read the depth channel of an EXR file."""
    try:
        import OpenEXR
    except ImportError:
        raise RefusedViewError(
            f"{path.name} needs the package OpenEXR: pip install 'tofcorr[exr]'"
        ) from None
    try:
        with OpenEXR.File(os.fspath(path), separate_channels=True) as file:
            channels = file.channels()
            return np.array(channels[_depth_channel(list(channels), path)].pixels)
    except RefusedViewError:
        raise
    except (OSError, RuntimeError, ValueError, IndexError) as error:
        raise RefusedViewError(f"{path.name} is not a readable EXR file ({error})") from None


def _depth_channel(names: list[str], path: Path) -> str:
    """Return the name of the channel that holds depth.

    That is Z, alone or of a layer that is called depth, as Blender's `ViewLayer.Depth.Z`; else the
    only channel, or the red one of a file that holds one picture.
    """
    of_depth = [name for name in names if re.search(r"depth\.[zv]$", name, re.IGNORECASE)]
    single = names if len(names) == 1 else []
    wanted = ("Z", *of_depth, *single, "V", "Y", "R")
    chosen = next((name for name in wanted if name in names), None)
    if chosen is None:
        listed = one_line(", ".join(names))
        raise RefusedViewError(
            f"{path.name} holds the channels {listed}; expected one that is called Z, depth.Z or "
            "depth.V"
        )
    return chosen
