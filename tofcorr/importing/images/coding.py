"""From the numbers of a depth image to metres: unit, invalid codes, byte order, rotation."""

from typing import Literal

import numpy as np
from pydantic import Field, PositiveFloat

from tofcorr.importing.report import RefusedViewError
from tofcorr.options import Options

_SWAPPED_SMOOTHER = 4.0
"""How many times smoother an image is with its bytes swapped if they are in the wrong order. Depth
read with the bytes swapped jumps by thousands between neighbours: on views of a Kinect v2 the
ratio is 100 to 270 in the wrong order, and its inverse in the right one."""

_ROWS_LOOKED_AT = 4
"""Every so many rows the byte order is looked at: thousands of pixels, quickly."""


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
    rotate: Literal[0, 90, 180, 270] = Field(default=0)

    def unit_of(self, dtype: np.dtype) -> float:
        """Return metres per count for images of a number type."""
        if self.unit_mm is not None:
            return 1e-3 * self.unit_mm
        return 1.0 if dtype.kind == "f" else 1e-3


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
    usable = np.isfinite(values) & (values > 0)
    for code in coding.invalid:
        usable &= values != code
    metres = np.where(usable, values * coding.unit_of(counts.dtype), np.nan)
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
    few = counts[::_ROWS_LOOKED_AT]
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
    if not both.any():
        return 0.0
    return float(np.abs(left - right)[both].mean())
