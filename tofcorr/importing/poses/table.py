"""Poses in a CSV table with a header row."""

import csv
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from tofcorr.errors import CalibrationDataError
from tofcorr.importing.poses.header import Header, header_of
from tofcorr.importing.poses.rotations import matrix_from_quaternion, matrix_from_rotation_vector
from tofcorr.importing.poses.text import read_text
from tofcorr.importing.poses.track import PoseTrack
from tofcorr.options.messages import one_line

# Each quantity under the names that tables give it, and the factor to SI units. Names as pandas,
# ROS and the `frames.csv` of a recording write them.
_TIME = {"stamp": 1.0, "timestamp_s": 1.0, "timestamp": 1.0, "time": 1.0, "time_s": 1.0, "t": 1.0,
         "timestamp_ms": 1e-3, "time_ms": 1e-3, "timestamp_us": 1e-6, "timestamp_ns": 1e-9,
         "time_ns": 1e-9}  # fmt: skip
# Seconds and nanoseconds of a ROS stamp, in the words of ROS 2 and of ROS 1.
_STAMP = (("stamp_sec", "stamp_nanosec"), ("stamp_secs", "stamp_nsecs"))
_NAME = ("name", "image", "file", "filename", "frame")
_QUATERNION = (("qx", "qy", "qz", "qw"), ("q_x", "q_y", "q_z", "q_w"), ("ox", "oy", "oz", "ow"))
_ROTATION_VECTOR = (("rx", "ry", "rz"),)


def read_table(path: Path) -> PoseTrack:
    """Read a CSV table of poses.

    Columns: `tx, ty, tz` (or `x, y, z`; `_mm` or `[mm]` behind each for millimetres), the rotation
    as `qx, qy, qz, qw` or as a rotation vector `rx, ry, rz` in radians, and either a time
    (`timestamp_s`, `time`, `timestamp_ms`, `timestamp_ns`, ...) or the image's name (`name`,
    `image`, `file`), or neither. `frames.csv` of a recording is such a table. The columns of a ROS
    message are understood as well, such as `pose.position.x` and `header.stamp.sec`. Cells are
    separated by commas, or by semicolons or tabs, and then decimals may have commas.

    Raises:
        CalibrationDataError: A column is missing or stands twice, or a cell is not a number.
    """
    text = read_text(path)
    head = header_of(text)
    if head is None:
        raise CalibrationDataError(f"{path}: expected a header row and poses, found none.")
    lines = text[text.index(head.line) + len(head.line) :].splitlines()
    rows = list(csv.reader(lines, delimiter=head.delimiter, skipinitialspace=True))
    rows = [row for row in rows if row and not row[0].startswith("#")]
    header, table = head.columns, _Table(path, head, rows)
    translation = table.translation()
    rotation = table.first_of(_QUATERNION)
    build = matrix_from_quaternion
    if rotation is None:
        rotation, build = table.first_of(_ROTATION_VECTOR), matrix_from_rotation_vector
    if rotation is None:
        euler = any(name.startswith(("roll", "pitch", "yaw")) for name in header)
        advice = " Turn roll, pitch and yaw into quaternions: their order has no standard."
        raise CalibrationDataError(
            f"{path}: expected the columns qx, qy, qz, qw or rx, ry, rz, got "
            f"{one_line(', '.join(header))}." + (advice if euler else "")
        )
    turns, poses = table.numbers(rotation), []
    for place in range(len(table.rows)):
        try:
            poses.append(build(translation[place], turns[place]))
        except ValueError as error:
            raise CalibrationDataError(f"{path}, row {place + 1}: {error}.") from None
    return PoseTrack.checked(
        np.array(poses).reshape(-1, 4, 4), str(path), table.times(), table.names()
    )


class _Table:
    """The cells of a table by their columns' names."""

    def __init__(self, path: Path, head: Header, rows: list[list[str]]) -> None:
        self.path, self.rows = path, rows
        self.columns = {name: place for place, name in enumerate(head.columns)}
        self._twice = {name for name in head.columns if head.columns.count(name) > 1}
        self._decimal_comma = head.delimiter != ","

    def first_of(self, choices: Sequence[tuple[str, ...]]) -> tuple[str, ...] | None:
        """Return the first choice whose columns all exist."""
        return next((c for c in choices if all(name in self.columns for name in c)), None)

    def translation(self) -> np.ndarray:
        """Return translations, shape (P, 3), metres."""
        for letters in ("tx ty tz", "x y z", "px py pz"):
            for ending, factor in (("", 1.0), ("_m", 1.0), ("_mm", 1e-3)):
                names = tuple(f"{letter}{ending}" for letter in letters.split())
                if all(name in self.columns for name in names):
                    return factor * self.numbers(names)
        listed = one_line(", ".join(self.columns))
        raise CalibrationDataError(f"{self.path}: expected the columns tx, ty, tz, got {listed}.")

    def times(self) -> np.ndarray | None:
        """Return time stamps in seconds, shape (P,); None without such a column."""
        parts = self.first_of(_STAMP)
        if parts is not None:
            return self.numbers(parts) @ (1.0, 1e-9)
        name = next((name for name in _TIME if name in self.columns), None)
        return None if name is None else _TIME[name] * self.numbers((name,))[:, 0]

    def names(self) -> list[str] | None:
        """Return the image's name of each pose; None without such a column."""
        name = next((name for name in _NAME if name in self.columns), None)
        if name is None:
            return None
        return [self._cell(place, name) for place in range(len(self.rows))]

    def numbers(self, names: tuple[str, ...]) -> np.ndarray:
        """Return some columns, shape (P, C)."""
        for name in self._twice.intersection(names):
            raise CalibrationDataError(
                f"{self.path}: two columns are '{one_line(name)}'; expected the poses of one frame."
            )
        values = np.empty((len(self.rows), len(names)))
        for place in range(len(self.rows)):
            for k, name in enumerate(names):
                cell = self._cell(place, name)
                number = cell.replace(",", ".") if self._decimal_comma else cell
                try:
                    values[place, k] = float(number)
                except ValueError:
                    raise CalibrationDataError(
                        f"{self.path}, row {place + 1}, column '{name}': expected a number, got "
                        f"'{cell[:40]}'."
                    ) from None
        return values

    def _cell(self, place: int, name: str) -> str:
        row, column = self.rows[place], self.columns[name]
        if column >= len(row):
            raise CalibrationDataError(
                f"{self.path}, row {place + 1}: expected {len(self.columns)} cells, got {len(row)}."
            )
        return row[column].strip()
