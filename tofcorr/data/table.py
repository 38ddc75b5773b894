"""The file `frames.csv`: one row a frame."""

import csv
import io
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any, Self

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from tofcorr.errors import CalibrationDataError
from tofcorr.geometry import se3

FILE_NAME = "frames.csv"
_TRANSLATION = ("tx", "ty", "tz")
_QUATERNION = ("qx", "qy", "qz", "qw")
_NORMAL = ("nx", "ny", "nz")
_POSE_AND_PLANE = (*_TRANSLATION, *_QUATERNION, *_NORMAL, "d")
REQUIRED_COLUMNS = ("frame", "timestamp_s", *_POSE_AND_PLANE, "target")

_MICRO = 1e-6
# Optional numeric columns of the file: the attribute that holds them, and its unit in the file.
OPTIONAL_NUMBERS = {
    "integration_time_us": ("integration_time", _MICRO),
    "body_temperature_c": ("body_temperature", 1.0),
    "room_temperature_c": ("room_temperature", 1.0),
    "ambient": ("ambient", 1.0),
}
COLUMN_OF = {attribute: column for column, (attribute, _) in OPTIONAL_NUMBERS.items()} | {
    "pose_id": "pose_id"
}

# How far the length of a quaternion or a normal may be from one, after the format.
_UNIT_LENGTH_TOLERANCE = 1e-3


@dataclass(frozen=True, kw_only=True, eq=False)
class FrameRow:
    """What is known of one frame besides its images.

    Attributes:
        timestamp: Seconds since the recording began.
        world_from_tool: Pose of the robot's tool, shape (4, 4); the identity without a robot.
        normal_world: Unit normal of the target's plane n . x + d = 0, on the camera's side, (3,).
        offset: d of that plane, metres.
        target: `white`, `checkerboard` or another name.
        pose_id: Frames with one id were taken without moving; None if unknown.
        integration_time: Seconds; None if unknown.
        body_temperature: Of the camera, degrees Celsius; None if unknown.
        room_temperature: Degrees Celsius; None if unknown.
        ambient: Background light in the camera's own linear units; None if unknown.
    """

    timestamp: float
    world_from_tool: np.ndarray
    normal_world: np.ndarray
    offset: float
    target: str
    pose_id: int | str | None = None
    integration_time: float | None = None
    body_temperature: float | None = None
    room_temperature: float | None = None
    ambient: float | None = None


@dataclass(frozen=True, kw_only=True, eq=False)
class FrameTable:
    """The rows of `frames.csv` as arrays, one entry a frame; units as in `FrameRow`.

    An optional column that the file lacks is None. An empty cell in an optional column is NaN
    (the empty text in `pose_id`): unknown, never zero.

    Attributes:
        timestamp: Shape (N,), seconds.
        world_from_tool: Shape (N, 4, 4), metres.
        normal_world: Shape (N, 3), exactly unit length.
        offset: Shape (N,), metres.
        target: Shape (N,), text.
        pose_id: Shape (N,), text, or None.
        integration_time: Shape (N,), seconds, or None.
        body_temperature: Shape (N,), degrees Celsius, or None.
        room_temperature: Shape (N,), degrees Celsius, or None.
        ambient: Shape (N,), or None.
    """

    timestamp: np.ndarray
    world_from_tool: np.ndarray
    normal_world: np.ndarray
    offset: np.ndarray
    target: np.ndarray
    pose_id: np.ndarray | None = None
    integration_time: np.ndarray | None = None
    body_temperature: np.ndarray | None = None
    room_temperature: np.ndarray | None = None
    ambient: np.ndarray | None = None

    def __len__(self) -> int:
        """Return the number of frames."""
        return len(self.timestamp)

    def select(self, indices: Sequence[int] | np.ndarray) -> Self:
        """Return the table of these frames, in this order."""
        chosen = np.asarray(indices, dtype=np.int64)
        columns = {field.name: getattr(self, field.name) for field in fields(self)}
        present = {name: column for name, column in columns.items() if column is not None}
        return replace(self, **{name: column[chosen] for name, column in present.items()})

    def row(self, index: int) -> FrameRow:
        """Return one frame's row; an empty cell is None in it."""
        return FrameRow(
            timestamp=float(self.timestamp[index]),
            world_from_tool=self.world_from_tool[index],
            normal_world=self.normal_world[index],
            offset=float(self.offset[index]),
            target=str(self.target[index]),
            pose_id=None if self.pose_id is None else (str(self.pose_id[index]) or None),
            **{name: self._number(name, index) for name, _ in OPTIONAL_NUMBERS.values()},
        )

    def rows(self) -> list[FrameRow]:
        """Return every frame's row."""
        return [self.row(index) for index in range(len(self))]

    def _number(self, attribute: str, index: int) -> float | None:
        column = getattr(self, attribute)
        return None if column is None or np.isnan(column[index]) else float(column[index])


def read_table(path: Path) -> FrameTable:
    """Read and check `frames.csv`.

    Columns may stand in any order, and further ones are let be. Within the tolerance of the
    format quaternions are normalised, and a plane's n and d divided by the length of n.

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
        if not name:
            raise _wrong(path, frame, "target", "a name such as 'white'", name)

    number = {name: _finite(cells[name], name, path) for name in ("timestamp_s", *_POSE_AND_PLANE)}
    quaternion = np.stack([number[name] for name in _QUATERNION], axis=1)
    normal = np.stack([number[name] for name in _NORMAL], axis=1)
    _check_unit_length(quaternion, "quaternion qx,qy,qz,qw", path)
    length = _check_unit_length(normal, "normal nx,ny,nz", path)
    translation = np.stack([number[name] for name in _TRANSLATION], axis=1)
    world_from_tool = se3.matrix_from_quaternion_translation(
        torch.from_numpy(quaternion), torch.from_numpy(translation)
    ).numpy()
    return FrameTable(
        timestamp=number["timestamp_s"],
        world_from_tool=world_from_tool,
        normal_world=normal / length[:, None],
        offset=number["d"] / length,
        target=np.array(cells["target"]),
        pose_id=np.array(cells["pose_id"]) if "pose_id" in cells else None,
        **_optional_numbers(cells, path),
    )


def table_text(rows: Iterable[FrameRow]) -> str:
    """Return `frames.csv` of these rows; an optional column is left out if no row has it."""
    rows = list(rows)
    optional: dict[str, Callable[[FrameRow], Any]] = {
        "pose_id": lambda row: row.pose_id,
        **{
            column: _reader_of(attribute, unit)
            for column, (attribute, unit) in OPTIONAL_NUMBERS.items()
        },
    }
    kept = {
        name: value for name, value in optional.items() if any(value(r) is not None for r in rows)
    }
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow([*REQUIRED_COLUMNS, *kept])
    for frame, row in enumerate(rows):
        # The csv module writes None as an empty cell: unknown.
        writer.writerow([frame, *_required_cells(row), *(value(row) for value in kept.values())])
    return text.getvalue()


def _required_cells(row: FrameRow) -> list[Any]:
    pose = np.asarray(row.world_from_tool, dtype=np.float64)
    quaternion = Rotation.from_matrix(pose[:3, :3]).as_quat()  # Scalar last, as in the file.
    normal = np.asarray(row.normal_world, dtype=np.float64)
    numbers = [row.timestamp, *pose[:3, 3], *quaternion, *normal, row.offset]
    return [*(float(value) for value in numbers), row.target]


def _reader_of(attribute: str, unit: float) -> Callable[[FrameRow], float | None]:
    def read(row: FrameRow) -> float | None:
        value = getattr(row, attribute)
        if value is None or np.isnan(value):
            return None
        # In a foreign unit 15 digits: 500 us shall not become 500.00000000000006.
        return float(value) if unit == 1 else float(f"{value / unit:.15g}")

    return read


def _read_cells(path: Path) -> dict[str, list[str]]:
    """Read the file into columns of text; blank lines, which hold no row, are passed over."""
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
        # Only plain digits: int() would also take '1_0' and ' 7'.
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
        if "_" in cell:  # Python's float() takes 1_0 for ten.
            raise _wrong(path, frame, name, "a number", cell)
    return values


def _finite(cells: list[str], name: str, path: Path) -> np.ndarray:
    values = _numbers(cells, name, path)
    for frame in np.flatnonzero(~np.isfinite(values))[:1]:
        raise _wrong(path, int(frame), name, "a finite number", cells[frame])
    return values


def _optional_numbers(cells: dict[str, list[str]], path: Path) -> dict[str, np.ndarray]:
    found = {}
    for column, (attribute, unit) in OPTIONAL_NUMBERS.items():
        if column not in cells:
            continue
        values = _numbers(cells[column], column, path)
        positive = column == "integration_time_us"
        wrong = np.isinf(values) | ((values <= 0) if positive else False)
        for frame in np.flatnonzero(wrong)[:1]:
            expected = "a positive number" if positive else "a finite number"
            raise _wrong(path, int(frame), column, f"{expected} or nothing", cells[column][frame])
        found[attribute] = values * unit
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
