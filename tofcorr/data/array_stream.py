"""An `.npy` file written frame by frame."""

from contextlib import suppress
from pathlib import Path

import numpy as np

from tofcorr.errors import CalibrationDataError


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
        self._write_header(0)
        self._header_bytes = self._file.tell()

    def convert(self, frame: np.ndarray, where: str) -> np.ndarray:
        """Return the frame in the type of the file.

        Raises:
            CalibrationDataError: The frame has another shape; the message begins with `where`.
        """
        array = np.asarray(frame)
        if array.shape != self._frame_shape:
            raise CalibrationDataError(
                f"{where}: expected shape {self._frame_shape}, got {array.shape}."
            )
        with np.errstate(over="ignore"):
            return np.ascontiguousarray(array, dtype=self._dtype)

    def write(self, frame: np.ndarray) -> None:
        """Append a converted frame."""
        self._file.write(frame.data)

    def finish(self, num_frames: int) -> None:
        """Write the number of frames into the header and close the file."""
        self._file.seek(0)
        self._write_header(num_frames)
        if self._file.tell() != self._header_bytes:  # NumPy leaves room for 21 digits.
            raise OSError(0, "the array has too many frames for its header")
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
