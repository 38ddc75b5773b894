"""Pose files of other programs: TUM's lines, tables with a header, matrices, MoveIt's samples.

`read_poses` finds the format and reads the file; `POSE_FORMATS` has one line a format.
"""

import csv
import re
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from tofcorr.errors import CalibrationDataError, ConfigError
from tofcorr.importing.npy import load_numbers
from tofcorr.importing.pose_track import PoseTrack
from tofcorr.options import one_line, read_yaml

_LARGEST_MB = 256
"""Largest pose file read, MB: a day of poses at 10 Hz takes 100 MB."""

_ROUNDING = 1e-3
"""How far the length of a quaternion may be from one: what three decimals do to it."""

# Each quantity under the names that tables give it, and the factor to SI units. Names as pandas,
# ROS and the `frames.csv` of a recording write them.
_TIME = {"stamp": 1.0, "timestamp_s": 1.0, "timestamp": 1.0, "time": 1.0, "time_s": 1.0, "t": 1.0,
         "timestamp_ms": 1e-3, "time_ms": 1e-3, "timestamp_us": 1e-6, "timestamp_ns": 1e-9,
         "time_ns": 1e-9}  # fmt: skip
# Seconds and nanoseconds of a ROS stamp, in the words of ROS 2 and of ROS 1.
_STAMP = (("stamp_sec", "stamp_nanosec"), ("stamp_secs", "stamp_nsecs"))
_NAME = ("name", "image", "file", "filename", "frame")
_TRANSLATION = {
    tuple(f"{letter}{unit}" for letter in letters): factor
    for letters in (("tx", "ty", "tz"), ("x", "y", "z"), ("px", "py", "pz"))
    for unit, factor in (("", 1.0), ("_m", 1.0), ("_mm", 1e-3))
}
_QUATERNION = (("qx", "qy", "qz", "qw"), ("q_x", "q_y", "q_z", "q_w"), ("ox", "oy", "oz", "ow"))
_ROTATION_VECTOR = (("rx", "ry", "rz"),)

Line = tuple[int, list[str]]
"""The number of a line, counted from one, and its fields."""


def read_poses(path: Path, pose_format: str | None = None) -> PoseTrack:
    """Read a pose file.

    Args:
        path: The file, or a folder with one matrix a file.
        pose_format: One of `POSE_FORMATS`; None: told from the content.

    Raises:
        CalibrationDataError: The file is missing or not of that format.
        ConfigError: There is no such format.
    """
    if not path.exists():
        raise CalibrationDataError(f"{path}: there is no such pose file.")
    name = pose_format or _guessed_format(path)
    if name not in POSE_FORMATS:
        known = ", ".join(name for name in POSE_FORMATS if name != "matrix")
        raise ConfigError(f"There is no pose format '{name}'. Known: {known}.")
    return POSE_FORMATS[name](path)


def _guessed_format(path: Path) -> str:
    """Tell the format of a pose file from its name and its first line."""
    if path.is_dir() or path.suffix.lower() == ".npy":
        return "matrices"
    if path.suffix.lower() in (".yaml", ".yml"):
        return "moveit"
    text = read_text(path)
    if text.lstrip()[:1] in ("{", "["):
        raise CalibrationDataError(
            f"{path}: poses are not read from JSON. Write them as CSV with a header row, as TUM's "
            "lines, or as matrices, 16 numbers a line."
        )
    if _header(text) is not None:
        return "csv"
    lines = lines_of(text)
    if not lines:
        raise CalibrationDataError(f"{path}: expected poses, found none.")
    number, fields = lines[0]
    if len(fields) not in (4, 8, 12, 13, 16, 17):
        raise CalibrationDataError(
            f"{path}: the format is not recognised: {len(fields)} numbers in line {number}. "
            "Expected 8 (TUM: time, translation, quaternion x y z w), 12 or 16 (a matrix), or a "
            "header row (CSV). Say which with --pose-format."
        )
    return "tum" if len(fields) == 8 else "matrices"


def read_text(path: Path) -> str:
    """Return the text of a file of bounded size.

    Raises:
        CalibrationDataError: There is no such file, it is too large, or it is not text.
    """
    try:
        with path.open("rb") as file:
            content = file.read(_LARGEST_MB * 10**6 + 1)
    except OSError as error:
        raise CalibrationDataError(f"{path}: cannot be read ({error.strerror}).") from None
    if len(content) > _LARGEST_MB * 10**6:
        raise CalibrationDataError(
            f"{path}: larger than {_LARGEST_MB} MB, the limit of a pose file here."
        )
    try:
        return content.decode("utf-8-sig")
    except UnicodeDecodeError:
        raise CalibrationDataError(
            f"{path}: expected a text file of poses, found binary content."
        ) from None


def lines_of(text: str) -> list[Line]:
    """Return the lines that hold something, with their fields; `#` and `%` begin comments.

    Fields are separated by white space, commas or semicolons.
    """
    contents = (re.sub(r"[#%].*", "", line) for line in text.splitlines())
    split = (re.sub("[,;]", " ", content).split() for content in contents)
    return [(number, fields) for number, fields in enumerate(split, start=1) if fields]


def _numbers(line: Line, path: Path, counts: tuple[int, ...]) -> np.ndarray:
    """Return the numbers of a line, which must be finite and as many as expected."""
    number, fields = line
    if len(fields) not in counts:
        wanted = " or ".join(map(str, counts))
        raise CalibrationDataError(
            f"{path}, line {number}: expected {wanted} numbers, got {len(fields)}."
        )
    try:
        values = np.array([float(field) for field in fields])
    except ValueError:
        shown = " ".join(fields)[:60]
        raise CalibrationDataError(
            f"{path}, line {number}: expected numbers, got '{shown}'."
        ) from None
    if not np.isfinite(values).all():
        raise CalibrationDataError(f"{path}, line {number}: expected finite numbers.")
    return values


def pose_from_quaternion(translation: np.ndarray, quaternion_xyzw: np.ndarray) -> np.ndarray:
    """Return a rigid transform, shape (4, 4).

    Args:
        translation: Shape (3,), metres.
        quaternion_xyzw: Shape (4,), scalar last, of unit length to 0.001.

    Raises:
        ValueError: The quaternion is not of unit length.
    """
    length = float(np.linalg.norm(quaternion_xyzw))
    if not abs(length - 1) <= _ROUNDING:
        raise ValueError(f"the quaternion (x, y, z, w) has length {length:.4g}; expected 1")
    return _transform(translation, Rotation.from_quat(quaternion_xyzw))


def _pose_from_rotation_vector(translation: np.ndarray, vector: np.ndarray) -> np.ndarray:
    """Return a rigid transform of an axis times an angle in radians (as UR robots report)."""
    angle = float(np.linalg.norm(vector))
    # Robots report half a turn at most, some up to a whole one.
    if not angle <= 2 * np.pi + _ROUNDING:
        raise ValueError(
            f"rx, ry, rz are read as an axis times an angle in radians, and the angle is "
            f"{angle:.4g}; degrees, or Euler angles, must be turned into quaternions qx, qy, qz, qw"
        )
    return _transform(translation, Rotation.from_rotvec(vector))


def _transform(translation: np.ndarray, rotation: Rotation) -> np.ndarray:
    transform = np.eye(4)
    transform[:3, :3], transform[:3, 3] = rotation.as_matrix(), translation
    return transform


def _read_tum(path: Path) -> PoseTrack:
    """Read TUM's lines: `timestamp tx ty tz qx qy qz qw`, metres and seconds."""
    times, poses = [], []
    for line in lines_of(read_text(path)):
        values = _numbers(line, path, (8,))
        try:
            poses.append(pose_from_quaternion(values[1:4], values[4:]))
        except ValueError as error:
            raise CalibrationDataError(f"{path}, line {line[0]}: {error}.") from None
        times.append(values[0])
    return PoseTrack.checked(np.array(poses), str(path), np.array(times))


def _read_moveit(path: Path) -> PoseTrack:
    """Read `effector_wrt_world` of every sample of a YAML list (moveit/moveit_calibration#34).

    A sample is written when it is taken: samples and images belong together in their order.
    `object_wrt_sensor` is not used: depth is what tofcorr measures.
    """
    try:
        values = read_yaml(path)
    except ConfigError as error:
        raise CalibrationDataError(str(error)) from None
    if not isinstance(values, list):
        raise CalibrationDataError(
            f"{path}: expected a list of samples, got {type(values).__name__}."
        )
    poses = []
    for place, sample in enumerate(values):
        given = sample.get("effector_wrt_world") if isinstance(sample, dict) else None
        numbers = any_numbers(given)
        if numbers.size != 16:
            raise CalibrationDataError(
                f"{path}: sample {place}: expected 'effector_wrt_world' with the 16 numbers of a "
                f"4x4 matrix, got {numbers.size}."
            )
        poses.append(numbers.reshape(4, 4))
    return PoseTrack.checked(np.array(poses), str(path))


def any_numbers(value: Any) -> np.ndarray:  # noqa: ANN401 - from a file
    """Return a value from a file as an array of float64; an empty one if it holds no numbers."""
    try:
        return np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError, OverflowError):
        return np.zeros(0)


def _read_matrices(path: Path) -> PoseTrack:
    """Read poses that are written as matrices, row by row, metres.

    Understood are a text file with 16 (or 12: without the last row) numbers a line, with or without
    a time stamp in front; a text file with four lines of four numbers a pose; an NPY array of shape
    (P, 4, 4), (P, 3, 4), (P, 16) or (P, 12); and a folder with one such file a pose, which is then
    called as the file is.
    """
    if path.is_dir():
        return _folder_of_matrices(path)
    if path.suffix.lower() == ".npy":
        values = _loaded(path)
        if not len(values.shape) or values[:1].size not in (12, 16):
            raise CalibrationDataError(
                f"{path}: expected an array of shape (P, 4, 4), (P, 3, 4), (P, 16) or (P, 12), "
                f"got {values.shape}."
            )
        return PoseTrack.checked(_square(values.reshape(len(values), -1)), str(path))
    lines = lines_of(read_text(path))
    in_blocks = bool(lines) and len(lines[0][1]) == 4
    counts = (4,) if in_blocks else (12, 13, 16, 17)
    rows = [_numbers(line, path, counts) for line in lines]
    if in_blocks:
        if len(rows) % 4:
            raise CalibrationDataError(
                f"{path}: expected four lines of four numbers a pose, got {len(rows)} lines."
            )
        return PoseTrack.checked(np.reshape(rows, (-1, 4, 4)), str(path))
    widths = {len(row) for row in rows}
    if len(widths) > 1:
        raise CalibrationDataError(
            f"{path}: expected as many numbers in every line, got {min(widths)} and {max(widths)}."
        )
    if not rows:
        raise CalibrationDataError(f"{path}: expected poses, found none.")
    values, stamped = np.array(rows), widths.pop() in (13, 17)
    times = values[:, 0] if stamped else None
    return PoseTrack.checked(_square(values[:, int(stamped) :]), str(path), times)


def _folder_of_matrices(path: Path) -> PoseTrack:
    files = sorted(file for file in path.iterdir() if file.suffix.lower() in (".txt", ".npy"))
    if not files:
        raise CalibrationDataError(f"{path}: expected one .txt or .npy file a pose, found none.")
    poses = []
    for file in files:
        if file.suffix.lower() == ".npy":
            values = _loaded(file).ravel()
        else:
            rows = [_numbers(one, file, (3, 4, 12, 16)) for one in lines_of(read_text(file))]
            values = np.concatenate(rows or [[]])
        if values.size not in (12, 16):
            raise CalibrationDataError(
                f"{file}: expected one pose of 12 or 16 numbers, got {values.size} numbers."
            )
        poses.append(_square(values.reshape(1, -1))[0])
    return PoseTrack.checked(np.array(poses), str(path), names=[file.stem for file in files])


def _loaded(path: Path) -> np.ndarray:
    try:
        return load_numbers(path).astype(np.float64)
    except ValueError as error:
        raise CalibrationDataError(f"{path}: {error}.") from None


def _square(values: np.ndarray) -> np.ndarray:
    """Return (P, 4, 4) from rows of 16 numbers, or of 12 without the last row."""
    last = np.tile([0.0, 0.0, 0.0, 1.0], (len(values), 1))
    return np.concatenate([values, last], axis=1)[:, :16].reshape(-1, 4, 4)


def _read_table(path: Path) -> PoseTrack:
    """Read a CSV table of poses.

    Columns: `tx, ty, tz` (or `x, y, z`; `_mm` or `[mm]` behind each for millimetres), the rotation
    as `qx, qy, qz, qw` or as a rotation vector `rx, ry, rz` in radians, and either a time
    (`timestamp_s`, `time`, `timestamp_ms`, `timestamp_ns`, ...) or the image's name (`name`,
    `image`, `file`), or neither. `frames.csv` of a recording is such a table. The columns of a ROS
    message are understood as well, such as `pose.position.x` and `header.stamp.sec`. Cells are
    separated by commas, or by semicolons or tabs, and then decimals may have commas.
    """
    table = _Table(path)
    translation = table.translation()
    rotation, build = table.first_of(_QUATERNION), pose_from_quaternion
    if rotation is None:
        rotation, build = table.first_of(_ROTATION_VECTOR), _pose_from_rotation_vector
    if rotation is None:
        euler = any(name.startswith(("roll", "pitch", "yaw")) for name in table.columns)
        advice = " Turn roll, pitch and yaw into quaternions: their order has no standard."
        raise CalibrationDataError(
            f"{path}: expected the columns qx, qy, qz, qw or rx, ry, rz, got {table.listed}."
            + (advice if euler else "")
        )
    poses = []
    for place, (move, turn) in enumerate(zip(translation, table.numbers(rotation), strict=True)):
        try:
            poses.append(build(move, turn))
        except ValueError as error:
            raise CalibrationDataError(f"{path}, row {place + 1}: {error}.") from None
    name = table.first_of((name,) for name in _NAME)
    names = None if name is None else table.cells(name[0])
    return PoseTrack.checked(np.reshape(poses, (-1, 4, 4)), str(path), table.times(), names)


class _Table:
    """The cells of a table by their columns' plain names."""

    def __init__(self, path: Path) -> None:
        text = read_text(path)
        head = _header(text)
        if head is None:
            raise CalibrationDataError(f"{path}: expected a header row and poses, found none.")
        self._path, (self._delimiter, self.columns, line) = path, head
        self.listed = one_line(", ".join(self.columns))
        lines = text[text.index(line) + len(line) :].splitlines()
        rows = csv.reader(lines, delimiter=self._delimiter, skipinitialspace=True)
        self._rows = [row for row in rows if row and not row[0].startswith("#")]

    def first_of(self, choices: Iterable[tuple[str, ...]]) -> tuple[str, ...] | None:
        """Return the first choice whose columns all exist."""
        return next((one for one in choices if set(one) <= set(self.columns)), None)

    def translation(self) -> np.ndarray:
        """Return translations, shape (P, 3), metres."""
        names = self.first_of(_TRANSLATION)
        if names is None:
            raise CalibrationDataError(
                f"{self._path}: expected the columns tx, ty, tz, got {self.listed}."
            )
        return _TRANSLATION[names] * self.numbers(names)

    def times(self) -> np.ndarray | None:
        """Return time stamps in seconds, shape (P,); None without such a column."""
        parts = self.first_of(_STAMP)
        if parts is not None:
            return self.numbers(parts) @ (1.0, 1e-9)
        names = self.first_of((name,) for name in _TIME)
        return None if names is None else _TIME[names[0]] * self.numbers(names)[:, 0]

    def cells(self, name: str) -> list[str]:
        """Return the text of a column."""
        column = len(self.columns) - 1 - self.columns[::-1].index(name)
        for place, row in enumerate(self._rows, start=1):
            if column >= len(row):
                raise CalibrationDataError(
                    f"{self._path}, row {place}: expected {len(self.columns)} cells, got "
                    f"{len(row)}."
                )
        return [row[column].strip() for row in self._rows]

    def numbers(self, names: tuple[str, ...]) -> np.ndarray:
        """Return some columns, shape (P, C)."""
        values = np.empty((len(self._rows), len(names)))
        for column, name in enumerate(names):
            if self.columns.count(name) > 1:
                raise CalibrationDataError(
                    f"{self._path}: two columns are '{one_line(name)}'; expected the poses of one "
                    "frame."
                )
            for place, cell in enumerate(self.cells(name)):
                number = cell if self._delimiter == "," else cell.replace(",", ".")
                try:
                    values[place, column] = float(number)
                except ValueError:
                    raise CalibrationDataError(
                        f"{self._path}, row {place + 1}, column '{name}': expected a number, got "
                        f"'{cell[:40]}'."
                    ) from None
        return values


def _plain_name(text: str) -> str:
    """Return a column's name in lower case, without the message that it is part of.

    Units in brackets are joined by an underscore. A ROS message's parts become the letters that
    other tables use: positions and translations x, y, z, orientations and rotations qx, qy, qz, qw.

    Example:
        >>> [_plain_name(name) for name in ("X [mm]", "pose.position.x", "/tf/base/rotation/w")]
        ['x_mm', 'x', 'qw']
        >>> [_plain_name(name) for name in ("#timestamp [ns]", "q_RS_w []", "header.stamp.nanosec")]
        ['timestamp_ns', 'qw', 'stamp_nanosec']
    """
    name = text.strip().lower().lstrip("#%_ ")
    unit = re.search(r"\s*[\[(]([^\])]*)[\])]$", name)
    ending = ""
    if unit is not None:
        name, ending = name[: unit.start()], f"_{unit[1].strip()}" if unit[1].strip() else ""
    *path, last = re.split(r"[./]", name)
    parts = {"position": "", "translation": "", "orientation": "q", "rotation": "q"}
    if path and path[-1] in parts:
        name = parts[path[-1]] + last
    elif path and path[-1] == "stamp":
        name = f"stamp_{last}"
    elif last == "stamp":
        name = last
    # As the EuRoC data set and others write: p_RS_R_x, q_RS_w.
    letter = re.fullmatch(r"(?:p|(q))_(?:\w+_)?([wxyz])", name)
    return ((letter[1] or "") + letter[2] if letter else name) + ending


def _header(text: str) -> tuple[str, list[str], str] | None:
    """Return the header row of a text; None if its first line is a row of numbers.

    Comments above it are passed over. A line that begins like a comment, with `#` or `%`, is the
    header if it names coordinates and the line below has as many cells.

    Returns:
        What separates cells, the plain names of the columns, and the row as it stands in the text.
    """
    lines = [line for line in text.splitlines() if line.strip()]
    for line, below in zip(lines, [*lines[1:], ""], strict=False):
        delimiter = max((",", ";", "\t"), key=line.count)
        cells = line.split(delimiter)
        columns = [_plain_name(cell) for cell in cells]
        if line.lstrip()[0] not in "#%":
            numbers = all(map(_is_number, line.replace(delimiter, " ").split()))
            return None if numbers else (delimiter, columns, line)
        same = 1 < len(cells) == below.count(delimiter) + 1
        if same and any(re.fullmatch(r"[tp]?x(_m|_mm)?", name) for name in columns):
            return delimiter, columns, line
    return None


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


POSE_FORMATS: Mapping[str, Callable[[Path], PoseTrack]] = {
    "tum": _read_tum,
    "csv": _read_table,
    "matrices": _read_matrices,
    "matrix": _read_matrices,
    "moveit": _read_moveit,
}
"""How each format is read."""
