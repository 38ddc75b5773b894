"""The image arrays of a recording: one line each."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from tofcorr.data.arrays import check_amplitude, check_depth, check_mask, check_raw
from tofcorr.errors import CalibrationDataError

Check = Callable[[np.ndarray, np.ndarray, Path], None]
CheckNew = Callable[[np.ndarray, str], None]


@dataclass(frozen=True, kw_only=True)
class ImageArray:
    """One array of a recording, with one image or one stack of images per frame.

    Attributes:
        name: Attribute of `Recording`; the file is `NAME.npy`.
        dtype: Type of its elements.
        per_frame: Leading axes of one frame, before rows and columns.
        required: Whether every recording has it.
        check: Refuses frames read from a file (frames, their numbers, the file) if a value is not
            allowed by the format; None: all values are allowed.
        check_new: The same for one frame that is to be written (frame, where it comes from).
    """

    name: str
    dtype: type[np.generic]
    per_frame: tuple[int, ...] = ()
    required: bool = False
    check: Check | None = None
    check_new: CheckNew | None = None

    def file(self, folder: Path) -> Path:
        """Return its file in the folder of a recording."""
        return folder / f"{self.name}.npy"

    def frame_shape(self, height: int, width: int) -> tuple[int, ...]:
        """Return the shape of one frame."""
        return (*self.per_frame, height, width)


def _check_new_amplitude(frame: np.ndarray, where: str) -> None:
    if np.any(frame < 0):
        raise CalibrationDataError(f"{where}: negative amplitude; expected zero or more.")


def _check_new_mask(frame: np.ndarray, where: str) -> None:
    if np.any((frame != 0) & (frame != 1)):
        raise CalibrationDataError(f"{where}: expected 0 or 1 everywhere.")


IMAGE_ARRAYS = {
    array.name: array
    for array in (
        ImageArray(name="depth", dtype=np.float32, required=True, check=check_depth),
        ImageArray(
            name="amplitude",
            dtype=np.float32,
            check=check_amplitude,
            check_new=_check_new_amplitude,
        ),
        ImageArray(name="mask", dtype=np.uint8, check=check_mask, check_new=_check_new_mask),
        ImageArray(name="raw", dtype=np.float32, per_frame=(4,), check=check_raw),
        ImageArray(name="true_depth", dtype=np.float32, check=check_depth),
    )
}
"""The arrays of the recording format, by name."""
