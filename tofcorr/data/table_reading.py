"""Reading `frames.csv`, and refusing what breaks the format."""

import csv
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch

from tofcorr.conditions import OPTIONAL_CONDITIONS
from tofcorr.data.arrays import LARGEST_DISTANCE
from tofcorr.data.columns import (
    NORMAL,
    POSE_AND_PLANE,
    QUATERNION,
    REQUIRED_COLUMNS,
    TIMESTAMP,
    TRANSLATION,
)
from tofcorr.data.table import FrameTable
from tofcorr.errors import CalibrationDataError, is_control
from tofcorr.geometry import se3
from tofcorr.options.numbers import LARGEST_NUMBER, SMALLEST_POSITIVE

# Largest difference from 1 of the length of a quaternion or a normal (no unit). The value is part
# of the recording format, version 1.
_UNIT_LENGTH_TOLERANCE = 1e-3


def read_table(path: Path) -> FrameTable:
    """Read and check `frames.csv`.

    Columns may come in any order; unknown columns are ignored. Quaternions are normalised, and a
    plane's n and d are divided by the length of n, if the length is within the format's tolerance.

    Raises:
        CalibrationDataError: The file is missing or breaks the format; the message names column
            and frame.
    """
    cells = _read_cells(path)
    missing = [name for name in REQUIRED_COLUMNS if name not in cells]
    if missing:
        raise CalibrationDataError(f"{path}: column {_names(missing)} is missing.")
    if not cells["frame"]:
        raise CalibrationDataError(f"{path}: a recording of no frame.")
    _check_frame_indices(cells["frame"], path)
    for frame, name in enumerate(cells["target"]):
        if not name or any(map(is_control, name)):
            raise _wrong(path, frame, "target", "a name such as 'white'", name)

    number = {name: _finite(cells[name], name, path) for name in (TIMESTAMP, *POSE_AND_PLANE)}
    quaternion = np.stack([number[name] for name in QUATERNION], axis=1)
    normal = np.stack([number[name] for name in NORMAL], axis=1)
    _check_unit_length(quaternion, "quaternion qx,qy,qz,qw", path)
    length = _check_unit_length(normal, "normal nx,ny,nz", path)
    translation = np.stack([number[name] for name in TRANSLATION], axis=1)
    world_from_tool = se3.matrix_from_quaternion_translation(
        torch.from_numpy(quaternion), torch.from_numpy(translation)
    ).numpy()
    for name in (*TRANSLATION, "d"):
        _refuse_far(number[name], cells[name], name, path)
    return FrameTable(
        timestamp=number[TIMESTAMP],
        world_from_tool=world_from_tool,
        normal_world=normal / length[:, None],
        offset=number["d"] / length,
        target=np.array(cells["target"]),
        pose_id=np.array(cells["pose_id"]) if "pose_id" in cells else None,
        **_optional_numbers(cells, path),
    )


def _read_cells(path: Path) -> dict[str, list[str]]:
    """Read the file into columns of text; blank lines are skipped."""
    try:
        with path.open(encoding="utf-8-sig", newline="") as file:
            lines = [line for line in csv.reader(file) if line]
    except FileNotFoundError:
        raise CalibrationDataError(f"{path}: there is no such file.") from None
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise CalibrationDataError(f"{path}: cannot be read as CSV ({error}).") from None
    if not lines:
        raise CalibrationDataError(f"{path}: is empty; expected a header row.")
    names = [name.strip() for name in lines[0]]
    if len(names) == 1 and ";" in names[0]:
        raise CalibrationDataError(f"{path}: columns are separated by ';'; commas are needed.")
    doubled = sorted({name for name in names if name and names.count(name) > 1})
    if doubled:
        raise CalibrationDataError(f"{path}: column {_names(doubled)} appears twice.")
    for frame, line in enumerate(lines[1:]):
        if len(line) != len(names):
            raise CalibrationDataError(
                f"{path}: frame {frame} has {len(line)} cells; the header has {len(names)}."
            )
    return {name: [line[i].strip() for line in lines[1:]] for i, name in enumerate(names)}


def _check_frame_indices(cells: list[str], path: Path) -> None:
    for frame, cell in enumerate(cells):
        # Only plain digits: int() also accepts '1_0' and ' 7'.
        if not (cell.isascii() and cell.isdigit() and len(cell) < 19 and int(cell) == frame):
            raise _wrong(path, frame, "frame", f"{frame} (counting up from zero)", cell)


def _numbers(cells: list[str], name: str, path: Path) -> np.ndarray:
    """Parse a column; empty cells give NaN."""
    values = np.full(len(cells), np.nan)
    for frame, cell in enumerate(cells):
        if not cell:
            continue
        try:
            values[frame] = float(cell)
        except ValueError:
            raise _wrong(path, frame, name, "a number", cell) from None
        if "_" in cell:  # Python's float() reads 1_0 as ten.
            raise _wrong(path, frame, name, "a number", cell)
    return values


def _finite(cells: list[str], name: str, path: Path) -> np.ndarray:
    values = _numbers(cells, name, path)
    for frame in np.flatnonzero(~np.isfinite(values))[:1]:
        raise _wrong(path, int(frame), name, "a finite number", cells[frame])
    for frame in np.flatnonzero(np.abs(values) > LARGEST_NUMBER)[:1]:
        raise _wrong(path, int(frame), name, f"at most {LARGEST_NUMBER:g}", cells[frame])
    return values


def _refuse_far(values: np.ndarray, cells: list[str], name: str, path: Path) -> None:
    for frame in np.flatnonzero(np.abs(values) > LARGEST_DISTANCE)[:1]:
        expected = f"metres, at most {LARGEST_DISTANCE:g}"
        raise _wrong(path, int(frame), name, expected, cells[frame])


def _optional_numbers(cells: dict[str, list[str]], path: Path) -> dict[str, np.ndarray]:
    found = {}
    for condition in OPTIONAL_CONDITIONS:
        column, positive = condition.column, condition.positive
        if column not in cells:
            continue
        values = _numbers(cells[column], column, path)
        wrong = np.isinf(values) | ((values <= SMALLEST_POSITIVE) if positive else False)
        wrong |= np.abs(values) > LARGEST_NUMBER
        for frame in np.flatnonzero(wrong)[:1]:
            expected = "a positive number" if positive else "a finite number"
            raise _wrong(path, int(frame), column, f"{expected} or nothing", cells[column][frame])
        found[condition.name] = values * condition.si_per_unit
    return found


def _check_unit_length(vectors: np.ndarray, name: str, path: Path) -> np.ndarray:
    with np.errstate(over="ignore"):
        length = np.sqrt((vectors**2).sum(axis=1))
    for frame in np.flatnonzero(~(np.abs(length - 1) <= _UNIT_LENGTH_TOLERANCE))[:1]:
        raise CalibrationDataError(
            f"{path}: frame {frame}: the {name} has length {length[frame]:.6g}; "
            "expected 1 to within 0.001."
        )
    return length


def _wrong(path: Path, frame: int, column: str, expected: str, got: str) -> CalibrationDataError:
    shown = repr(got[:40]) if got else "an empty cell"
    return CalibrationDataError(
        f"{path}: frame {frame}, column '{column}': expected {expected}, got {shown}."
    )


def _names(columns: Sequence[str]) -> str:
    return ", ".join(f"'{column}'" for column in columns)
