"""The `.npy` files of a recording: which there are, read in chunks, checked, and written."""

import io
import warnings
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from math import inf
from pathlib import Path

import numpy as np

from tofcorr.errors import CalibrationDataError
from tofcorr.files import UNREADABLE, open_regular, reading
from tofcorr.options import LARGEST_NUMBER

LARGEST_DISTANCE = 1e6
"""Largest distance and coordinate that is accepted, metres. Chosen: beyond any camera's range in
any unit; drivers write larger numbers, such as the largest of float32, for "no return"."""


@dataclass(frozen=True, kw_only=True)
class ImageArray:
    """One array of a recording, with one image or one stack of images per frame.

    Attributes:
        name: Attribute of `Recording`; the file is `NAME.npy`.
        dtype: Type of its elements.
        per_frame: Leading axes of one frame, before rows and columns.
        required: Whether every recording has it.
        low: Smallest finite value that the format allows.
        high: Largest one.
        expected: Says what a value should be.
    """

    name: str
    dtype: type[np.generic] = np.float32
    per_frame: tuple[int, ...] = ()
    required: bool = False
    low: float = -inf
    high: float = LARGEST_NUMBER
    expected: str = f"expected at most {LARGEST_NUMBER:g}"

    def file(self, folder: Path) -> Path:
        """Return its file in the folder of a recording."""
        return folder / f"{self.name}.npy"

    def frame_shape(self, height: int, width: int) -> tuple[int, ...]:
        """Return the shape of one frame."""
        return (*self.per_frame, height, width)

    def check(self, frames: np.ndarray, indices: Sequence[int] | np.ndarray, folder: Path) -> None:
        """Refuse frames if a value is not allowed by the format.

        NaN and infinity mean "unknown", or "no return", and are allowed.

        Args:
            frames: Shape (B, ..., H, W).
            indices: Their numbers, shape (B,), for the message.
            folder: The recording, for the message.

        Raises:
            CalibrationDataError: The message names frame, row and column.
        """
        # Minimum and maximum are NaN if any element is NaN; then the slower search follows.
        if frames.size == 0 or (frames.min() >= self.low and frames.max() <= self.high):
            return
        wrong = (frames < self.low) | (frames > self.high)
        # Minus infinity is negative where nothing may be.
        wrong &= np.isfinite(frames) | ((frames < 0) & (self.low == 0))
        for place in np.argwhere(wrong)[:1]:
            frame, *sample, row, column = place
            where = [f"frame {indices[frame]}", *(f"A{k}" for k in sample)]
            said = f"row {row}, column {column}: {frames[tuple(place)]:.6g}; {self.expected}"
            raise CalibrationDataError(f"{self.file(folder)}: {', '.join(where)}, {said}.")


_DISTANCE = "expected metres; NaN or zero where there was no return"
IMAGE_ARRAYS = {
    array.name: array
    for array in (
        ImageArray(name="depth", required=True, high=LARGEST_DISTANCE, expected=_DISTANCE),
        ImageArray(name="amplitude", low=0, expected=f"expected 0 to {LARGEST_NUMBER:g}"),
        ImageArray(name="mask", dtype=np.uint8, low=0, high=1, expected="expected 0 or 1"),
        ImageArray(name="raw", per_frame=(4,), low=-LARGEST_NUMBER),
        ImageArray(name="true_depth", high=LARGEST_DISTANCE, expected=_DISTANCE),
    )
}
"""The arrays of the recording format, by name."""


def open_array(path: Path, dtype: type[np.generic], frame_shape: tuple[int, ...]) -> np.memmap:
    """Map one array into memory and check its header.

    Args:
        path: The `.npy` file.
        dtype: Required type of its elements.
        frame_shape: Required shape after the first axis.

    Raises:
        CalibrationDataError: The file is missing, truncated, no `.npy` file, or of another
            type, order or shape.
    """
    with reading(path), open_regular(path, inf) as file, warnings.catch_warnings():
        warnings.simplefilter("ignore")  # NumPy warns of headers written by Python 2.
        try:
            array = np.lib.format.open_memmap(path, mode="r")
        except UNREADABLE as error:
            reason = " ".join(str(error).split())[:200]
            raise CalibrationDataError(f"{path}: not a readable .npy file ({reason}).") from None
        longer = file.seek(0, io.SEEK_END) - array.offset - array.nbytes
    if longer:
        raise CalibrationDataError(f"{path}: {longer} bytes stand behind the array; write it anew.")
    if array.dtype != np.dtype(dtype):
        raise CalibrationDataError(f"{path}: expected {np.dtype(dtype)}, got {array.dtype}.")
    if array.ndim != len(frame_shape) + 1 or array.shape[1:] != frame_shape:
        expected = ", ".join(["frames", *map(str, frame_shape)])
        raise CalibrationDataError(f"{path}: recording.yaml needs ({expected}), got {array.shape}.")
    if not array.flags.c_contiguous:
        raise CalibrationDataError(f"{path}: is in Fortran order; C order is needed.")
    return array


def read_frames(array: np.ndarray, indices: np.ndarray) -> np.ndarray:
    """Copy frames out of an array; out of a memory-mapped one with ordinary reads.

    Reading through the memory map would count every page read as memory of this process. With
    ordinary reads only the copy counts, however long the recording is.

    Args:
        array: An array from `open_array`, or one in memory.
        indices: Frames to read, in any order.

    Returns:
        Shape (len(indices), ...), writable.

    Raises:
        CalibrationDataError: The file has become shorter since it was opened.
    """
    indices = np.asarray(indices, dtype=np.int64)
    if not isinstance(array, np.memmap):
        return array[indices]
    frames = np.empty((len(indices), *array.shape[1:]), dtype=array.dtype)
    path = Path(str(array.filename))
    with reading(path), path.open("rb") as file:
        for frame, index in zip(frames, indices.tolist(), strict=True):
            file.seek(array.offset + index * frame.nbytes)
            if file.readinto(frame) < frame.nbytes:
                raise CalibrationDataError(f"{path}: cannot be read (it became shorter).")
    return frames


def frame_chunks(frames: np.ndarray, pixels: int, most: int) -> Iterator[np.ndarray]:
    """Split the numbers of frames, each of so many pixels, into runs of at most so many."""
    step = max(1, most // pixels)
    for start in range(0, len(frames), step):
        yield frames[start : start + step]


class ArrayStream:
    """One `.npy` file that grows frame by frame.

    The number of frames in its header is set when the stream is finished.

    Args:
        path: The file.
        dtype: Type of the elements.
        frame_shape: Shape of one frame.
    """

    def __init__(self, path: Path, dtype: np.dtype, frame_shape: tuple[int, ...]) -> None:
        if dtype.hasobject:
            raise ValueError(f"{path.name}: expected an array of numbers, got {dtype}.")
        path.parent.mkdir(exist_ok=True)
        self._dtype = dtype
        self._frame_shape = frame_shape
        self._file = path.open("w+b")
        self._write_header(0)  # NumPy leaves room for a count of 21 digits.

    def convert(self, frame: np.ndarray, where: str) -> np.ndarray:
        """Return the frame in the type of the file.

        Raises:
            CalibrationDataError: The frame has another shape, or values that the type cannot hold;
                the message begins with `where`.
        """
        if frame.shape != self._frame_shape:
            raise CalibrationDataError(f"{where}: expected {self._frame_shape}, got {frame.shape}.")
        with np.errstate(over="ignore", invalid="ignore"):
            converted = np.ascontiguousarray(frame, dtype=self._dtype)
        if self._dtype.kind in "biu" and not np.array_equal(converted, frame):
            raise CalibrationDataError(f"{where}: expected whole numbers of {self._dtype}.")
        return converted

    def write(self, frame: np.ndarray) -> None:
        """Append a converted frame, for others to read."""
        self._file.write(frame.data)
        self._file.flush()

    def finish(self, num_frames: int) -> None:
        """Write the number of frames into the header and close the file."""
        self._file.seek(0)
        self._write_header(num_frames)
        self._file.close()

    def abandon(self) -> None:
        """Close the file, whatever happens; for a file that will be removed."""
        # Closing writes the rest of the buffer, which fails again on a full disk.
        with suppress(OSError):
            self._file.close()

    def _write_header(self, num_frames: int) -> None:
        content = {
            "descr": np.lib.format.dtype_to_descr(self._dtype),
            "fortran_order": False,
            "shape": (num_frames, *self._frame_shape),
        }
        np.lib.format.write_array_header_1_0(self._file, content)
