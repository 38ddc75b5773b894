"""Poses as matrices: rows of 12 or 16 numbers, blocks of four lines, NPY, or a file a pose."""

from pathlib import Path

import numpy as np

from tofcorr.errors import CalibrationDataError
from tofcorr.importing.npy import load_numbers
from tofcorr.importing.poses.text import Line, lines_of, numbers_of, read_text
from tofcorr.importing.poses.track import PoseTrack

_LAST_ROW = [0.0, 0.0, 0.0, 1.0]
"""The last row of every pose, where a file leaves it out: that of a rigid transform."""


def read_matrices(path: Path) -> PoseTrack:
    """Read poses that are written as matrices, row by row, metres.

    Understood are a text file with 16 (or 12: without the last row) numbers a line, with or without
    a time stamp in front; a text file with four lines of four numbers a pose; an NPY array of shape
    (P, 4, 4), (P, 3, 4), (P, 16) or (P, 12); and a folder with one such file a pose, which is then
    called as the file is.

    Raises:
        CalibrationDataError: The file cannot be read, or holds something else.
    """
    if path.is_dir():
        return _folder(path)
    if path.suffix.lower() == ".npy":
        return PoseTrack.checked(_npy(path), str(path))
    lines = lines_of(read_text(path))
    if lines and len(lines[0].fields) == 4:
        return PoseTrack.checked(_blocks(lines, path), str(path))
    rows = [numbers_of(line, path, (12, 13, 16, 17)) for line in lines]
    widths = {len(row) for row in rows}
    if len(widths) > 1:
        raise CalibrationDataError(
            f"{path}: expected as many numbers in every line, got {min(widths)} and {max(widths)}."
        )
    if not rows:
        raise CalibrationDataError(f"{path}: expected poses, found none.")
    stamped = widths.pop() in (13, 17)
    values = np.array(rows)
    times = values[:, 0] if stamped else None
    return PoseTrack.checked(_square(values[:, int(stamped) :]), str(path), times)


def _square(values: np.ndarray) -> np.ndarray:
    """Return (P, 4, 4) from rows of 12 or 16 numbers."""
    if values.shape[1] == 16:
        return values.reshape(-1, 4, 4)
    last = np.broadcast_to(_LAST_ROW, (len(values), 1, 4))
    return np.concatenate([values.reshape(-1, 3, 4), last], axis=1)


def _blocks(lines: list[Line], path: Path) -> np.ndarray:
    rows = np.array([numbers_of(line, path, (4,)) for line in lines])
    if len(rows) % 4:
        raise CalibrationDataError(
            f"{path}: expected four lines of four numbers a pose, got {len(rows)} lines."
        )
    return rows.reshape(-1, 4, 4)


def _npy(path: Path) -> np.ndarray:
    try:
        values = load_numbers(path)
    except ValueError as error:
        raise CalibrationDataError(f"{path}: {error}.") from None
    if not len(values.shape) or values[:1].size not in (12, 16):
        raise CalibrationDataError(
            f"{path}: expected an array of shape (P, 4, 4), (P, 3, 4), (P, 16) or (P, 12), "
            f"got {values.shape}."
        )
    return _square(values.astype(np.float64).reshape(len(values), -1))


def _folder(path: Path) -> PoseTrack:
    files = sorted(file for file in path.iterdir() if file.suffix.lower() in (".txt", ".npy"))
    if not files:
        raise CalibrationDataError(f"{path}: expected one .txt or .npy file a pose, found none.")
    poses = []
    for file in files:
        one = read_matrices_of_one(file)
        poses.append(one)
    return PoseTrack.checked(np.array(poses), str(path), names=[file.stem for file in files])


def read_matrices_of_one(file: Path) -> np.ndarray:
    """Read a file that holds one pose, shape (4, 4).

    Raises:
        CalibrationDataError: It holds something else.
    """
    if file.suffix.lower() == ".npy":
        try:
            values = load_numbers(file).astype(np.float64).ravel()
        except ValueError as error:
            raise CalibrationDataError(f"{file}: {error}.") from None
    else:
        lines = lines_of(read_text(file))
        values = np.concatenate([numbers_of(line, file, (3, 4, 12, 16)) for line in lines] or [[]])
    if values.size not in (12, 16):
        raise CalibrationDataError(
            f"{file}: expected one pose of 12 or 16 numbers, got {values.size} numbers."
        )
    return _square(values.reshape(1, -1))[0]
