"""The `.npy` files of a recording: memory-mapped, checked, and read in chunks."""

import io
import tokenize
import warnings
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from tofcorr.errors import CalibrationDataError
from tofcorr.options.numbers import LARGEST_NUMBER

# Size of a chunk of frames, bytes. Set by hand: large enough for fast reads, small for any memory.
_CHUNK_BYTES = 16_000_000
LARGEST_DISTANCE = 1e6
"""Largest distance and coordinate that is accepted, metres. Chosen: beyond any camera's range in
any unit; drivers write larger numbers, such as the largest of float32, for "no return"."""
# All errors that NumPy raises on a damaged header: its own ValueError and those of its parser.
_UNREADABLE = (
    *(ValueError, OSError, EOFError, SyntaxError, tokenize.TokenError, TypeError, KeyError),
    *(AttributeError, IndexError, OverflowError, RecursionError, MemoryError),
)


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
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # NumPy warns of headers written by Python 2.
            array = np.lib.format.open_memmap(path, mode="r")
    except FileNotFoundError:
        raise CalibrationDataError(f"{path}: there is no such file.") from None
    except _UNREADABLE as error:
        reason = " ".join(str(error).split())[:200]
        raise CalibrationDataError(f"{path}: not a readable .npy file ({reason}).") from None
    if array.dtype != np.dtype(dtype):
        raise CalibrationDataError(
            f"{path}: expected {np.dtype(dtype).name} ({np.dtype(dtype).str}), "
            f"got {array.dtype.name} ({array.dtype.str})."
        )
    if array.ndim != len(frame_shape) + 1 or array.shape[1:] != frame_shape:
        expected = ", ".join(["frames", *map(str, frame_shape)])
        raise CalibrationDataError(
            f"{path}: expected shape ({expected}), got {array.shape}. "
            "Does recording.yaml describe this camera?"
        )
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
    frame_bytes = array[:1].nbytes
    path = Path(str(array.filename))
    # Consecutive frames are read at once.
    starts = np.flatnonzero(np.diff(indices, prepend=-2) != 1)
    stops = np.append(starts[1:], len(indices))
    try:
        with path.open("rb", buffering=0) as file:
            for start, stop in zip(starts, stops, strict=True):
                file.seek(array.offset + int(indices[start]) * frame_bytes)
                _fill(file, frames[start:stop].reshape(-1).view(np.uint8).data)
    except OSError as error:
        raise CalibrationDataError(f"{path}: cannot be read ({error.strerror or error}).") from None
    return frames


def check_depth(depth: np.ndarray, indices: np.ndarray, path: Path) -> None:
    """Refuse a finite distance that is no distance; NaN, infinity and <= 0 mean "no return".

    Args:
        depth: Frames, shape (B, H, W), metres.
        indices: Their numbers, shape (B,), for the message.
        path: The file, for the message.
    """
    # The maximum is NaN if any element is NaN; then the slower search follows.
    if depth.size == 0 or depth.max() <= LARGEST_DISTANCE:
        return
    for frame, row, column in np.argwhere(np.isfinite(depth) & (depth > LARGEST_DISTANCE))[:1]:
        raise CalibrationDataError(
            f"{path}: frame {indices[frame]}, row {row}, column {column}: "
            f"{depth[frame, row, column]:.6g} is no distance in metres; expected NaN or zero where "
            "there was no return."
        )


def check_amplitude(amplitude: np.ndarray, indices: np.ndarray, path: Path) -> None:
    """Refuse an amplitude that is negative, or finite and larger than any number read.

    NaN and infinity mean that it is unknown.

    Args:
        amplitude: Frames, shape (B, H, W).
        indices: Their numbers, shape (B,), for the message.
        path: The file, for the message.
    """
    # Minimum and maximum are NaN if any element is NaN; then the slower search follows.
    if amplitude.size == 0 or (amplitude.min() >= 0 and amplitude.max() <= LARGEST_NUMBER):
        return
    wrong = (amplitude < 0) | (np.isfinite(amplitude) & (amplitude > LARGEST_NUMBER))
    for frame, row, column in np.argwhere(wrong)[:1]:
        found = amplitude[frame, row, column]
        what = "negative amplitude" if found < 0 else "no amplitude:"
        raise CalibrationDataError(
            f"{path}: frame {indices[frame]}, row {row}, column {column}: "
            f"{what} {found:.6g}; expected 0 to {LARGEST_NUMBER:g}."
        )


def check_raw(raw: np.ndarray, indices: np.ndarray, path: Path) -> None:
    """Refuse a sample that is finite and larger than any number read.

    Args:
        raw: Frames, shape (B, 4, H, W).
        indices: Their numbers, shape (B,), for the message.
        path: The file, for the message.
    """
    if raw.size == 0 or (raw.min() >= -LARGEST_NUMBER and raw.max() <= LARGEST_NUMBER):
        return
    for frame, sample, row, column in np.argwhere(
        np.isfinite(raw) & (np.abs(raw) > LARGEST_NUMBER)
    )[:1]:
        raise CalibrationDataError(
            f"{path}: frame {indices[frame]}, A{sample}, row {row}, column {column}: "
            f"{raw[frame, sample, row, column]:.6g} is larger than {LARGEST_NUMBER:g}."
        )


def check_mask(mask: np.ndarray, indices: np.ndarray, path: Path) -> None:
    """Refuse a mask with values other than 0 and 1; arguments as in `check_amplitude`."""
    if mask.size == 0 or mask.max() <= 1:
        return
    for frame, row, column in np.argwhere(mask > 1)[:1]:
        raise CalibrationDataError(
            f"{path}: frame {indices[frame]}, row {row}, column {column}: "
            f"expected 0 or 1, got {mask[frame, row, column]}."
        )


def frame_chunks(num_frames: int, frame_bytes: int) -> Iterator[np.ndarray]:
    """Split 0..num_frames-1 into runs of about 16 MB."""
    step = max(1, _CHUNK_BYTES // max(1, frame_bytes))
    for start in range(0, num_frames, step):
        yield np.arange(start, min(start + step, num_frames))


def _fill(file: io.FileIO, view: memoryview) -> None:
    """Read until `view` is full."""
    while view.nbytes:
        count = file.readinto(view)
        if not count:
            raise OSError(0, "the file has become shorter since it was opened")
        view = view[count:]
