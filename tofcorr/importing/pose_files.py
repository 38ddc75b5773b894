"""Pose files of other programs: TUM's lines, tables with a header, matrices, MoveIt's samples.

`read_poses` finds the format and reads the file; `POSE_FORMATS` has one line a format.
"""

import csv
import re
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path

import numpy as np

from tofcorr.data.table import rigid_transforms
from tofcorr.errors import CalibrationDataError
from tofcorr.importing.numbers import any_numbers, finite_numbers, lines_of, load_numbers, read_text
from tofcorr.importing.pose_track import PoseTrack
from tofcorr.options import one_line, parse_yaml

# Each quantity under the names that tables give it, and the factors to SI units. Names as pandas,
# ROS (1 and 2) and the `frames.csv` of a recording write them.
_TIME = {
    **{(f"stamp_{second}", f"stamp_{part}"): (1.0, 1e-9)
       for second, part in (("sec", "nanosec"), ("secs", "nsecs"))},
    **{(name,): (1.0,) for name in ("stamp", "timestamp_s", "timestamp", "time", "time_s", "t")},
    **{(f"{name}_{unit}",): (factor,) for name in ("timestamp", "time")
       for unit, factor in (("ms", 1e-3), ("us", 1e-6), ("ns", 1e-9))},
}  # fmt: skip
_NAME = tuple((name,) for name in ("name", "image", "file", "filename", "frame"))
_TRANSLATION = {
    tuple(f"{letter}{unit}" for letter in letters): factor
    for letters in (("tx", "ty", "tz"), ("x", "y", "z"), ("px", "py", "pz"))
    for unit, factor in (("", 1.0), ("_m", 1.0), ("_mm", 1e-3))
}
_ROTATION = (
    *(("qx", "qy", "qz", "qw"), ("q_x", "q_y", "q_z", "q_w"), ("ox", "oy", "oz", "ow")),
    ("rx", "ry", "rz"),
)
"""Quaternions, scalar last, and vectors: an axis times an angle in radians, as UR robots report."""


def read_poses(path: Path, pose_format: str | None = None) -> PoseTrack:
    """Read a pose file.

    Args:
        path: The file, or a folder with one matrix a file.
        pose_format: One of `POSE_FORMATS`; None: told from the content.

    Raises:
        CalibrationDataError: The file is missing or not of that format.
    """
    return POSE_FORMATS[pose_format or _guessed_format(path)](path)


def _guessed_format(path: Path) -> str:
    """Tell the format of a pose file from its name and its first line."""
    if path.is_dir() or path.suffix.lower() == ".npy":
        return "matrices"
    if path.suffix.lower() in (".yaml", ".yml"):
        return "moveit"
    text = read_text(path)
    if _header(text) is not None:
        return "csv"
    lines = lines_of(text)
    if not lines:
        raise CalibrationDataError(f"{path}: expected poses, found none.")
    number, fields = lines[0]
    if len(fields) not in (4, 8, 12, 13, 16, 17):
        said = f"line {number} has {len(fields)} numbers"
        raise CalibrationDataError(f"{path}: {said}; expected 8 (TUM), 12, 16 or a header.")
    return "tum" if len(fields) == 8 else "matrices"


def _read_tum(path: Path) -> PoseTrack:
    """Read TUM's lines: `timestamp tx ty tz qx qy qz qw`, metres and seconds."""
    lines = lines_of(read_text(path))
    every = [finite_numbers(fields, f"{path}, line {k}", (8,)) for k, fields in lines]
    rows = np.reshape(every, (-1, 8))
    poses = rigid_transforms(rows[:, 1:4], rows[:, 4:], lambda k: f"{path}, line {lines[k][0]}")
    return PoseTrack.checked(poses, str(path), rows[:, 0])


def _read_moveit(path: Path) -> PoseTrack:
    """Read `effector_wrt_world` of every sample of a YAML list (moveit/moveit_calibration#34).

    A sample is written when it is taken: samples and images belong together in their order.
    `object_wrt_sensor` is not used: depth is what tofcorr measures.
    """
    values = parse_yaml(read_text(path), str(path), CalibrationDataError)
    if not isinstance(values, list):
        raise CalibrationDataError(f"{path}: expected samples, got {type(values).__name__}.")
    poses = []
    for place, sample in enumerate(values):
        given = sample.get("effector_wrt_world") if isinstance(sample, dict) else None
        where = f"{path}: 'effector_wrt_world' of sample {place}"
        poses.append(finite_numbers(given, where, (16,)))
    return PoseTrack.checked(np.reshape(poses, (-1, 4, 4)), str(path))


def _read_matrices(path: Path) -> PoseTrack:
    """Read poses that are written as matrices, row by row, metres.

    Understood are a text file with 16 (or 12: without the last row) numbers a line, with or without
    a time stamp in front; a text file with four lines of four numbers a pose; an NPY array of shape
    (P, 4, 4), (P, 3, 4), (P, 16) or (P, 12); and a folder with one such file a pose, which is then
    called as the file is.
    """
    if path.is_dir():
        files = sorted(file for file in path.iterdir() if file.suffix.lower() in (".txt", ".npy"))
        every = [finite_numbers(_rows(f, (3, 4, 12, 16)), str(f), (12, 16)) for f in files]
        poses, names = [_square(one[None])[0] for one in every], [file.stem for file in files]
        return PoseTrack.checked(np.array(poses), str(path), names=names)
    values = _rows(path, (4, 12, 13, 16, 17))
    if values.shape[1] == 4:
        if len(values) % 4:
            raise CalibrationDataError(f"{path}: expected four lines a pose, got {len(values)}.")
        values = values.reshape(-1, 16)
    stamped = values.shape[1] in (13, 17)
    times = values[:, 0] if stamped else None
    return PoseTrack.checked(_square(values[:, int(stamped) :]), str(path), times)


def _rows(path: Path, counts: tuple[int, ...]) -> np.ndarray:
    """Read the numbers of a text or an NPY array, one of some counts a row, shape (R, C)."""
    if path.suffix.lower() == ".npy":
        values = load_numbers(path, lambda why: CalibrationDataError(f"{path}: {why}."))
        if not values.size or values.size // len(np.atleast_1d(values)) not in counts:
            raise CalibrationDataError(f"{path}: expected (P, 4, 4) or (P, 16), is {values.shape}.")
        return values.astype(np.float64).reshape(len(values), -1)
    lines = lines_of(read_text(path))
    rows = [finite_numbers(fields, f"{path}, line {k}", counts) for k, fields in lines]
    widths = {len(row) for row in rows} or {16}
    if len(widths) > 1:
        raise CalibrationDataError(f"{path}: its lines have {sorted(widths)} numbers each.")
    return np.reshape(rows, (-1, min(widths)))


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
    text = read_text(path)
    head = _header(text)
    if head is None:
        raise CalibrationDataError(f"{path}: expected a header row and poses, found none.")
    delimiter, columns, lines = head
    cut = csv.reader(lines, delimiter=delimiter, skipinitialspace=True)
    rows = [row for row in cut if row and not row[0].startswith("#")]
    short = next((k for k, row in enumerate(rows, start=1) if len(row) < len(columns)), None)
    if short is not None:
        raise CalibrationDataError(f"{path}, row {short}: expected {len(columns)} cells.")
    # The last of several columns of one name.
    cells = {name: [row[k].strip() for row in rows] for k, name in enumerate(columns)}

    def first_of(choices: Iterable[tuple[str, ...]], wanted: str = "") -> tuple[str, ...]:
        """Return the first choice whose columns all exist; none if there is none and none wanted.

        Raises:
            CalibrationDataError: There is none of those wanted.
        """
        found = next((one for one in choices if set(one) <= set(columns)), ())
        if wanted and not found:
            euler = any(name.startswith(("roll", "pitch", "yaw")) for name in columns)
            advice = " Turn roll, pitch and yaw into quaternions: their order has no standard."
            held = one_line(", ".join(columns))
            raise CalibrationDataError(f"{path}: expected {wanted}, got {held}.{advice * euler}")
        return found

    def numbers(name: str) -> np.ndarray:
        """Return the numbers of a column, shape (P,)."""
        if columns.count(name) > 1:
            raise CalibrationDataError(f"{path}: two columns are '{one_line(name)}'; expected one.")
        texts = [cell if delimiter == "," else cell.replace(",", ".") for cell in cells[name]]
        found = any_numbers(texts)
        if len(found) < len(texts):
            wrong = next(k for k, text in enumerate(texts) if any_numbers(text).shape != ())
            where = f"{path}, row {wrong + 1}, column '{name}'"
            raise CalibrationDataError(f"{where}: expected a number, got '{texts[wrong][:40]}'.")
        return found

    move = first_of(_TRANSLATION, "tx, ty, tz")
    translation = _TRANSLATION[move] * np.array([numbers(one) for one in move]).T
    turn = first_of(_ROTATION, "qx, qy, qz, qw or rx, ry, rz")
    rotation = np.array([numbers(one) for one in turn]).T
    time, name = first_of(_TIME), first_of(_NAME)
    return PoseTrack.checked(
        rigid_transforms(translation, rotation, lambda k: f"{path}, row {k + 1}"),
        str(path),
        np.array(_TIME[time]) @ [numbers(one) for one in time] if time else None,
        cells[name[0]] if name else None,
    )


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
    parts["stamp"] = "stamp_"
    if path and path[-1] in parts:
        name = parts[path[-1]] + last
    elif last == "stamp":
        name = last
    # As the EuRoC data set and others write: p_RS_R_x, q_RS_w.
    letter = re.fullmatch(r"(?:p|(q))_(?:\w+_)?([wxyz])", name)
    return ((letter[1] or "") + letter[2] if letter else name) + ending


def _header(text: str) -> tuple[str, list[str], list[str]] | None:
    """Return the header row of a text; None if its first line is a row of numbers.

    Comments above it are passed over. A line that begins like a comment, with `#` or `%`, is the
    header if it names coordinates and the line below has as many cells.

    Returns:
        What separates cells, the plain names of the columns, and the lines below.
    """
    lines = [line for line in text.splitlines() if line.strip()]
    for number, line in enumerate(lines, start=1):
        rows = lines[number:]
        delimiter = max((",", ";", "\t"), key=line.count)
        columns = [_plain_name(cell) for cell in line.split(delimiter)]
        if line.lstrip()[0] not in "#%":
            words = line.replace(delimiter, " ").split()
            return None if any_numbers(words).size == len(words) else (delimiter, columns, rows)
        same = rows and 1 < len(columns) == rows[0].count(delimiter) + 1
        if same and any(re.fullmatch(r"[tp]?x(_m|_mm)?", name) for name in columns):
            return delimiter, columns, rows
    return None


POSE_FORMATS: Mapping[str, Callable[[Path], PoseTrack]] = {
    "tum": _read_tum,
    "csv": _read_table,
    "matrices": _read_matrices,
    "matrix": _read_matrices,
    "moveit": _read_moveit,
}
"""How each format is read."""
